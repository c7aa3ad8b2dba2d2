//! Broadcasts on serial lines: each memory carries them out once, however many unit ids it has.

use std::ptr;

use holdfast_memory::Memory;
use holdfast_protocol::pdu::{self, ExceptionCode, reply};

use crate::link::exception_in;
use crate::server::reports::comm_events::Received;
use crate::server::reports::refused_request::RefusedRequest;
use crate::server::requests::journaled_write;
use crate::server::requests::unit_server::{UnitServer, exceeds_ranges};
use crate::server::rights::peer_rights::PeerRights;

impl UnitServer {
    /// Carries out a broadcast write (Serial Line V1.02, 2.1). It counts as one message without a
    /// reply, even if several memories carry it out. `permit` is asked before each that the peer may write, and
    /// `note` receives each memory, the reply that it would have sent, where a log has the write, and the permit if
    /// the write may have been carried out. A journal is waited for, because what follows on the line
    /// expects the effects. A device is not: a write into a range whose writes are passed on is refused, or a device
    /// that does not answer would hold up the line. Returns a refusal by a memory that the peer may write.
    pub async fn broadcast<P>(
        &self,
        rights: &PeerRights,
        request: &[u8],
        mut permit: impl FnMut() -> Option<P>,
        mut note: impl FnMut(Option<&Memory>, &[u8], Option<u64>, Option<P>),
    ) -> Option<RefusedRequest> {
        let function_code = request.first().copied().unwrap_or_default();
        self.counters.request(function_code);
        self.counters.unanswered.add();
        self.comm_events.receive(Received::Broadcast);
        let (mut carried_out, mut refused, mut reported) = (false, None, None);
        let may = |unit_id| {
            rights.allows(unit_id, function_code) && !exceeds_ranges(rights, unit_id, request)
        };
        for unit_id in
            one_unit_of_each_memory(rights, |unit_id| !self.listen_only.is_on(unit_id), may)
        {
            let mut permit = may(unit_id).then(&mut permit).flatten();
            let journal =
                rights.memory(unit_id).filter(|memory| memory.has_journal() && permit.is_some());
            let (reply, log_sequence) = match journal {
                Some(memory) => journaled_write::carry_out(memory, request).await,
                None => {
                    let (mut reply, asked) = ([0; pdu::MAX_LEN], (function_code, request));
                    let is_permitted = permit.is_some();
                    let done = self.serve(rights, unit_id, asked, || is_permitted, &mut reply);
                    permit = permit.filter(|_| done.is_ok());
                    let len = match done {
                        Ok(len) => len.unwrap_or_default(),
                        Err(code) => reply::exception(function_code, code, &mut reply),
                    };
                    (reply[..len].to_vec(), None)
                }
            };
            match exception_in(&reply) {
                Some(code) => refused = refused.or(ExceptionCode::from_code(code)),
                None => carried_out = true,
            }
            if may(unit_id) {
                reported =
                    reported.or(RefusedRequest::from_reply(rights, unit_id, request, &reply));
            }
            note(rights.memory(unit_id), &reply, log_sequence, permit);
        }
        match refused {
            Some(code) => self.counters.exception(code),
            None if carried_out => self.counters.events.add(),
            None => {}
        }
        self.comm_events.send(None, false);
        reported
    }
}

/// One unit id per memory, chosen among the `wanted` unit ids: the first one that may do what is asked, or else
/// the first one.
fn one_unit_of_each_memory(
    rights: &PeerRights,
    wanted: impl Fn(u8) -> bool,
    may: impl Fn(u8) -> bool,
) -> Vec<u8> {
    let mut found: Vec<(u8, &Memory)> = Vec::new();
    for unit_id in (0..=u8::MAX).filter(|unit_id| wanted(*unit_id)) {
        let Some(memory) = rights.memory(unit_id) else { continue };
        match found.iter_mut().find(|(_, known)| ptr::eq(*known, memory)) {
            None => found.push((unit_id, memory)),
            Some((chosen, _)) if !may(*chosen) && may(unit_id) => *chosen = unit_id,
            Some(_) => {}
        }
    }
    found.into_iter().map(|(unit_id, _)| unit_id).collect()
}
