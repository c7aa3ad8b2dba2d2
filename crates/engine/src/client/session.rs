//! Many requests in flight on one connection, matched by transaction id (Messaging on TCP/IP
//! Implementation Guide V1.0b, 4.4.2).
//!
//! The rules this file keeps: a reply counts only when transaction id, unit id, function and length are
//! those asked for. A late reply, to a request that was given up, is dropped and counted. Whatever
//! else does not fit says that the two sides no longer mean the same thing, and ends the connection.

use std::collections::HashMap;

use holdfast_protocol::frame::mbap::{self, Next};
use holdfast_protocol::pdu::{Request, Response, ResponseError};
use thiserror::Error;

/// The connection can't be trusted any more.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Broken {
    #[error("a header with protocol id {0}")]
    Protocol(u16),
    #[error("a header with length {0}")]
    Length(u16),
    #[error("a reply with transaction id {0}, which no request has")]
    Transaction(u16),
    #[error("a reply from unit {found} to a request to unit {expected}")]
    Unit { expected: u8, found: u8 },
    #[error("{0}")]
    Response(ResponseError),
}

#[derive(Debug)]
struct Pending {
    unit_id: u8,
    /// The request, to judge the reply by; empty when nobody waits for it any more.
    pdu: Vec<u8>,
    given_up: bool,
}

/// The requests in flight on one connection.
#[derive(Debug, Default)]
pub struct Session {
    pending: HashMap<u16, Pending>,
    waiting: usize,
    next_id: u16,
    /// The beginning of a frame.
    partial: Vec<u8>,
    late: u64,
    broken: bool,
}

impl Session {
    /// Appends a request to `out` and returns its transaction id; `None` when all ids are in use.
    /// `pdu` is an encoded [`Request`].
    pub fn send(&mut self, unit_id: u8, pdu: &[u8], out: &mut Vec<u8>) -> Option<u16> {
        if self.pending.len() > usize::from(u16::MAX) {
            return None;
        }
        let mut id = self.next_id;
        while self.pending.contains_key(&id) {
            id = id.wrapping_add(1);
        }
        self.next_id = id.wrapping_add(1);
        out.extend_from_slice(&mbap::header(id, unit_id, pdu.len()));
        out.extend_from_slice(pdu);
        self.pending.insert(id, Pending { unit_id, pdu: pdu.to_vec(), given_up: false });
        self.waiting += 1;
        Some(id)
    }

    /// Gives a request up: its reply, should it come, is dropped.
    pub fn give_up(&mut self, id: u16) {
        if let Some(pending) = self.pending.get_mut(&id).filter(|pending| !pending.given_up) {
            pending.given_up = true;
            self.waiting -= 1;
        }
    }

    /// Requests whose replies are waited for.
    pub fn waiting(&self) -> usize {
        self.waiting
    }

    /// Replies that came after their requests had been given up.
    pub fn late(&self) -> u64 {
        self.late
    }

    /// Whether the last bytes received were the beginning of a reply. When a request times out then,
    /// the connection is in doubt: if the rest never comes, the next reply is taken for it.
    pub fn is_amid_reply(&self) -> bool {
        !self.partial.is_empty()
    }

    /// Whether the connection is to be closed.
    pub fn is_broken(&self) -> bool {
        self.broken
    }

    /// Takes received bytes, which may end anywhere, and calls `reply` for each request that they
    /// answer, in the order of the replies.
    ///
    /// # Errors
    /// [`Broken`]: the connection is to be closed.
    pub fn receive(
        &mut self,
        bytes: &[u8],
        reply: impl FnMut(u16, Result<Response<'_>, ResponseError>),
    ) -> Result<(), Broken> {
        let received = self.take(bytes, reply);
        self.broken |= received.is_err();
        received
    }

    fn take(
        &mut self,
        bytes: &[u8],
        mut reply: impl FnMut(u16, Result<Response<'_>, ResponseError>),
    ) -> Result<(), Broken> {
        let mut partial = std::mem::take(&mut self.partial);
        let mut rest = if partial.is_empty() {
            bytes
        } else {
            partial.extend_from_slice(bytes);
            &partial
        };
        loop {
            match mbap::next(rest) {
                Next::Incomplete => break,
                Next::Foreign { protocol_id, .. } => return Err(Broken::Protocol(protocol_id)),
                Next::Broken { length } => return Err(Broken::Length(length)),
                Next::Frame { transaction_id, unit_id, pdu, len } => {
                    rest = &rest[len..];
                    self.judge(transaction_id, unit_id, pdu, &mut reply)?;
                }
            }
        }
        self.partial = rest.to_vec();
        Ok(())
    }

    fn judge(
        &mut self,
        id: u16,
        unit_id: u8,
        pdu: &[u8],
        reply: &mut impl FnMut(u16, Result<Response<'_>, ResponseError>),
    ) -> Result<(), Broken> {
        let pending = self.pending.remove(&id).ok_or(Broken::Transaction(id))?;
        if pending.given_up {
            self.late += 1;
            return Ok(());
        }
        self.waiting -= 1;
        if unit_id != pending.unit_id {
            return Err(Broken::Unit { expected: pending.unit_id, found: unit_id });
        }
        // It was encoded from a request.
        let request = Request::parse(&pending.pdu).map_err(ResponseError::Exception);
        let response = request.and_then(|request| request.response(pdu));
        reply(id, response);
        match response {
            Err(
                error @ (ResponseError::Function { .. }
                | ResponseError::Length
                | ResponseError::Echo),
            ) => Err(Broken::Response(error)),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use holdfast_protocol::pdu::{ExceptionCode, Range};

    use super::*;

    fn sent(session: &mut Session, count: usize) -> Vec<u16> {
        let mut pdu = [0; holdfast_protocol::pdu::MAX_LEN];
        let len = Request::ReadHoldingRegisters(Range::new(3, 1).unwrap()).encode(&mut pdu);
        (0..count).map(|_| session.send(7, &pdu[..len], &mut Vec::new()).unwrap()).collect()
    }

    fn frame(id: u16, unit_id: u8, pdu: &[u8]) -> Vec<u8> {
        [&mbap::header(id, unit_id, pdu.len())[..], pdu].concat()
    }

    type Got = Vec<(u16, Result<Vec<u8>, ResponseError>)>;

    fn receive(session: &mut Session, bytes: &[u8]) -> (Got, Result<(), Broken>) {
        let mut got = Vec::new();
        let end = session.receive(bytes, |id, response| {
            let registers = response.map(|response| match response {
                Response::Registers(registers) => registers.as_bytes().to_vec(),
                other => panic!("{other:?}"),
            });
            got.push((id, registers));
        });
        (got, end)
    }

    #[test]
    fn replies_in_any_order_and_any_pieces_find_their_requests() {
        let mut session = Session::default();
        let ids = sent(&mut session, 3);
        let stream = [
            frame(ids[2], 7, &[3, 2, 0, 30]),
            frame(ids[0], 7, &[3, 2, 0, 10]),
            frame(ids[1], 7, &[0x83, 2]),
        ]
        .concat();
        let mut all = Vec::new();
        for byte in stream {
            let (got, end) = receive(&mut session, &[byte]);
            assert_eq!(end, Ok(()));
            all.extend(got);
        }
        let exception = ResponseError::Exception(ExceptionCode::IllegalDataAddress);
        assert_eq!(
            all,
            [(ids[2], Ok(vec![0, 30])), (ids[0], Ok(vec![0, 10])), (ids[1], Err(exception))]
        );
        assert_eq!(session.waiting(), 0);
    }

    #[test]
    fn a_late_reply_is_dropped_and_counted_and_comes_once() {
        let mut session = Session::default();
        let ids = sent(&mut session, 2);
        session.give_up(ids[0]);
        let late = frame(ids[0], 7, &[3, 2, 0, 1]);
        assert_eq!(receive(&mut session, &late), (Vec::new(), Ok(())));
        assert_eq!((session.late(), session.waiting()), (1, 1));
        assert_eq!(receive(&mut session, &late).1, Err(Broken::Transaction(ids[0])));
    }

    #[test]
    fn what_does_not_fit_ends_the_connection() {
        let cases: [(Vec<u8>, Broken); 6] = [
            (frame(9, 7, &[3, 2, 0, 1]), Broken::Transaction(9)),
            (frame(0, 8, &[3, 2, 0, 1]), Broken::Unit { expected: 7, found: 8 }),
            (frame(0, 7, &[3, 4, 0, 1, 0, 1]), Broken::Response(ResponseError::Length)),
            (
                frame(0, 7, &[4, 2, 0, 1]),
                Broken::Response(ResponseError::Function { expected: 3, found: 4 }),
            ),
            (vec![0, 0, 0, 1, 0, 3, 7, 3, 0], Broken::Protocol(1)),
            (vec![0, 0, 0, 0, 0, 1, 7], Broken::Length(1)),
        ];
        for (bytes, broken) in cases {
            let mut session = Session::default();
            sent(&mut session, 1);
            assert_eq!(receive(&mut session, &bytes).1, Err(broken));
        }
    }

    #[test]
    fn ids_of_requests_that_wait_are_not_used_again() {
        let mut session = Session::default();
        let [first] = sent(&mut session, 1)[..] else { panic!() };
        let ids = sent(&mut session, 65_535);
        assert!(!ids.contains(&first));
        assert!(session.send(7, &[3, 0, 0, 0, 1], &mut Vec::new()).is_none());
    }
}
