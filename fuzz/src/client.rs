//! The client side of a connection: a transport and what the device may do, then steps of one byte each,
//! some with data behind them.

use std::collections::BTreeMap;
use std::time::Duration;

use holdfast_protocol::client::{
    AcceptUnit, Closed, Connection, Done, Echo, Ticket, Tolerance, Transport,
};
use holdfast_protocol::frame::{ascii, mbap, rtu};
use holdfast_protocol::pdu::EncodedRequest;

const TIMEOUT: Duration = Duration::from_secs(1);
const SILENCE: Duration = Duration::from_millis(2);
const TRANSPORTS: [Transport; 7] = [
    Transport::Tcp,
    Transport::Udp,
    Transport::RtuOverTcp,
    Transport::RtuOverUdp,
    Transport::AsciiOverTcp,
    Transport::SerialRtu { silence: SILENCE },
    Transport::SerialAscii { silence: SILENCE },
];
/// Many more turns than any request needs to end.
const TURNS: usize = 1000;

/// Each request has exactly one result, which is its timeout at the latest, and a response is what its
/// request asked for.
pub fn check(data: &[u8]) {
    let [transport, tolerance, ref steps @ ..] = *data else { return };
    let transport = TRANSPORTS[usize::from(transport) % TRANSPORTS.len()];
    let mut run = Run {
        transport,
        connection: Connection::tolerant(transport, tolerances(tolerance), Duration::ZERO),
        waiting: BTreeMap::new(),
        now: Duration::ZERO,
    };
    let mut rest = steps;
    while let Some((step, behind)) = rest.split_first() {
        rest = run.step(*step, behind);
    }
    run.end();
}

fn tolerances(bits: u8) -> Tolerance {
    let has = |bit: u8| bits >> bit & 1 == 1;
    Tolerance {
        accept_unit: [AcceptUnit::Requested, AcceptUnit::Also(9), AcceptUnit::Any]
            [usize::from(bits) % 3],
        pad: has(2),
        echo: [Echo::Auto, Echo::Always, Echo::Never][usize::from(bits >> 3) % 3],
        pause: if has(5) { Duration::from_millis(10) } else { Duration::ZERO },
        close_after: if has(6) { 3 } else { 0 },
        retries: u8::from(has(7)),
        write_multiple: has(4),
        ..Tolerance::default()
    }
}

struct Run {
    transport: Transport,
    connection: Connection,
    /// The requests without a result, and whether one is wanted.
    waiting: BTreeMap<Ticket, (EncodedRequest, bool)>,
    now: Duration,
}

impl Run {
    /// Does one step. Returns what is behind it.
    fn step<'d>(&mut self, step: u8, behind: &'d [u8]) -> &'d [u8] {
        let (part, rest) = crate::counted(behind);
        match step % 8 {
            0 => {
                self.send(part);
                rest
            }
            1 => {
                self.receive(part);
                rest
            }
            // A fuzzer does not find checksums, nor the id of a request: the part as the PDU of a frame.
            2 => {
                if let Some((unit_id, pdu)) = part.split_first() {
                    self.receive(&self.frame(*unit_id, pdu));
                }
                rest
            }
            3 => {
                self.connection.sent(self.connection.outgoing().len());
                behind
            }
            4 => {
                self.advance(Duration::from_millis(1));
                behind
            }
            5 => {
                self.advance(TIMEOUT / 4);
                behind
            }
            6 => {
                if let Some((ticket, (_, is_wanted))) = self.waiting.iter_mut().next_back() {
                    *is_wanted = false;
                    self.connection.cancel(*ticket, self.now);
                }
                behind
            }
            _ => {
                self.reconnect();
                behind
            }
        }
    }

    fn send(&mut self, part: &[u8]) {
        let Some((unit_id, pdu)) = part.split_first() else { return };
        let parsed = EncodedRequest::parse(pdu).ok();
        let Some(request) = parsed.or_else(|| EncodedRequest::opaque(pdu)) else { return };
        if self.connection.has_room()
            && let Ok(ticket) = self.connection.send(*unit_id, &request, TIMEOUT, self.now)
        {
            assert!(self.waiting.insert(ticket, (request, true)).is_none());
        }
    }

    /// A frame of the transport. Its transaction id is that of the last request that has no result.
    fn frame(&self, unit_id: u8, pdu: &[u8]) -> Vec<u8> {
        let id = self.waiting.last_key_value().map_or(0, |(ticket, _)| ticket.0 as u16);
        let mut room = Vec::new();
        let len = match self.transport {
            Transport::Tcp | Transport::Udp => {
                let mut frame = [0; mbap::MAX_LEN];
                let len = mbap::encode(id, unit_id, pdu, &mut frame);
                room.extend_from_slice(&frame);
                len
            }
            Transport::AsciiOverTcp | Transport::SerialAscii { .. } => {
                let mut frame = [0; ascii::MAX_LEN];
                let len = ascii::encode(unit_id, pdu, &mut frame);
                room.extend_from_slice(&frame);
                len
            }
            _ => {
                let mut frame = [0; rtu::MAX_LEN];
                let len = rtu::encode(unit_id, pdu, &mut frame);
                room.extend_from_slice(&frame);
                len
            }
        };
        room.truncate(len.unwrap_or(0));
        room
    }

    fn receive(&mut self, bytes: &[u8]) {
        let Run { connection, waiting, now, .. } = self;
        connection.receive(bytes, *now, |done| finish(waiting, &done));
    }

    fn advance(&mut self, by: Duration) {
        self.now += by;
        let Run { connection, waiting, now, .. } = self;
        connection.advance(*now, |done| finish(waiting, &done));
    }

    fn reconnect(&mut self) {
        let Run { connection, waiting, now, .. } = self;
        connection.close(Closed::ByPeer, |done| finish(waiting, &done));
        waiting.clear();
        let mut next = Connection::tolerant(self.transport, Tolerance::default(), *now);
        next.follow(connection.take_past(*now));
        *connection = next;
    }

    /// Lets the time pass: all requests end.
    fn end(mut self) {
        for _ in 0..TURNS {
            let Some(deadline) = self.connection.deadline() else { break };
            self.connection.sent(self.connection.outgoing().len());
            self.advance(deadline.saturating_sub(self.now));
        }
        assert_eq!(self.connection.in_flight(), 0, "all requests have ended");
        assert!(self.waiting.values().all(|(_, is_wanted)| !is_wanted), "{:?}", self.waiting);
    }
}

/// Notes the result of a request.
fn finish(waiting: &mut BTreeMap<Ticket, (EncodedRequest, bool)>, done: &Done<'_>) {
    let (request, is_wanted) = waiting.remove(&done.ticket).expect("one result for each request");
    assert!(is_wanted, "no result of a cancelled request");
    // A broadcast has no reply.
    if let (Ok(response), [_, ..]) = (&done.outcome, done.pdu) {
        crate::response::is_answer(&request, done.pdu, response);
    }
}
