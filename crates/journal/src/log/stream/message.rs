//! Messages of a log: steps of one node that travel together, or none.
//!
//! A message begins with a mark and a version. Bytes without the mark were not sent by a node.

use std::sync::Arc;

use bytes::{Buf, Bytes};
use holdfast_memory::{Memory, Step};
use thiserror::Error;

use crate::encoding::{self, DecodeError};
use crate::log::settings::is_word;

const MARK: [u8; 3] = *b"HFL";

// Each message and snapshot has the oldest version that can express it, so that older nodes read it.

/// The first version of messages, snapshots and streams. Nothing in it is under a lease.
pub(in crate::log) const FIRST_VERSION: u8 = 1;

/// The version of messages with steps under leases, and the newest one of snapshots.
pub(in crate::log) const WITH_LEASES: u8 = 2;

/// The version of messages with a deadline. Older nodes would carry out what all others refuse.
const WITH_DEADLINE: u8 = 3;

/// The version of messages with a [`Notice`]. Older nodes would not close the seals that all others do.
const WITH_NOTICE: u8 = 4;

/// The newest version of messages.
pub(in crate::log) const VERSION: u8 = WITH_NOTICE;

/// The number of bytes before each step: its length.
pub(in crate::log) const STEP_LEN_BYTES: usize = size_of::<u32>();

/// The node that sent a message, and the number of the message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Origin {
    pub node: String,
    /// Grows with each start of the node, in the order of the log.
    pub start: u64,
    /// Grows with each message of a start.
    pub counter: u64,
}

impl Origin {
    /// The value of the header `Nats-Msg-Id`.
    pub(in crate::log) fn message_id(&self) -> String {
        format!("{}/{}/{}", self.node, self.start, self.counter)
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::log) struct Message {
    pub(in crate::log) origin: Origin,
    /// Whether all nodes compare their contents here.
    pub(in crate::log) compares: bool,
    /// The steps of a message that the stream has stored later are refused. In nanoseconds of Unix time, by
    /// the clock of the stream.
    pub(in crate::log) deadline: Option<i64>,
    /// Only in a message without steps.
    pub(in crate::log) notice: Option<Notice>,
    pub(in crate::log) steps: Vec<Step>,
}

/// What nodes tell each other when one of them starts and a seal that opens once is open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::log) enum Notice {
    /// The node has just started, and asks whether another node was running.
    Asks,
    /// The node was running when it applied the message at this sequence.
    Answers { sequence: u64 },
    /// No node has answered. Seals that open once are closed, if no message has come between this one and the
    /// one at this sequence.
    Closes { behind: u64 },
}

impl Notice {
    fn encoded(self) -> (u8, u64) {
        match self {
            Notice::Asks => (0, 0),
            Notice::Answers { sequence } => (1, sequence),
            Notice::Closes { behind } => (2, behind),
        }
    }

    fn decode(bytes: &mut &[u8]) -> Option<Notice> {
        match (bytes.try_get_u8().ok()?, bytes.try_get_u64_le().ok()?) {
            (0, 0) => Some(Notice::Asks),
            (1, sequence) => Some(Notice::Answers { sequence }),
            (2, behind) => Some(Notice::Closes { behind }),
            _ => None,
        }
    }
}

/// Why bytes are not a message.
#[derive(Debug, PartialEq, Eq, Error)]
pub(in crate::log) enum MessageError {
    #[error("its version is {0}")]
    Version(u8),
    #[error("it was not sent by a node")]
    Foreign,
    #[error(
        "it is of another log with this name, whose servers are joined with these (as by a leaf node) and have a \
         JetStream of their own: give one of the logs another name"
    )]
    OtherLog,
    #[error("it is malformed")]
    Malformed,
    #[error("it is of a node beyond the {MAX_NODES} that a log may have had")]
    TooManyNodes,
    #[error("step {index}: {error}")]
    Step { index: usize, error: DecodeError },
}

/// How many nodes a log may have had.
pub(in crate::log) const MAX_NODES: usize = 1024;

/// The most bytes before the steps, with those before one step.
pub(in crate::log) const OVERHEAD_BYTES: usize = 128;

/// Encodes a message with a notice.
pub(in crate::log) fn encode_notice(origin: &Origin, compares: bool, notice: Notice) -> Bytes {
    let mut out = Vec::with_capacity(OVERHEAD_BYTES);
    encode_head(WITH_NOTICE, origin, compares, &mut out);
    let (kind, sequence) = notice.encoded();
    out.push(kind);
    out.extend_from_slice(&sequence.to_le_bytes());
    out.into()
}

/// Encodes a message of steps that are encoded already.
pub(in crate::log) fn encode<'a>(
    origin: &Origin,
    compares: bool,
    deadline: Option<i64>,
    steps: impl ExactSizeIterator<Item = &'a [u8]> + Clone,
) -> Bytes {
    let len: usize = steps.clone().map(|step| step.len() + STEP_LEN_BYTES).sum();
    let mut out = Vec::with_capacity(len + OVERHEAD_BYTES);
    let has_leases = steps.clone().any(encoding::is_under_lease);
    let version = match deadline {
        Some(_) => WITH_DEADLINE,
        None if has_leases => WITH_LEASES,
        None => FIRST_VERSION,
    };
    encode_head(version, origin, compares, &mut out);
    if let Some(deadline) = deadline {
        out.extend_from_slice(&deadline.to_le_bytes());
    }
    for step in steps {
        out.extend_from_slice(&u32::try_from(step.len()).expect("steps are short").to_le_bytes());
        out.extend_from_slice(step);
    }
    out.into()
}

fn encode_head(version: u8, origin: &Origin, compares: bool, out: &mut Vec<u8>) {
    out.extend_from_slice(&MARK);
    out.push(version);
    out.push(u8::from(compares));
    out.push(u8::try_from(origin.node.len()).expect("names of nodes are short"));
    out.extend_from_slice(origin.node.as_bytes());
    out.extend_from_slice(&origin.start.to_le_bytes());
    out.extend_from_slice(&origin.counter.to_le_bytes());
}

pub(in crate::log) fn decode(
    bytes: &[u8],
    members: &[Arc<Memory>],
) -> Result<Message, MessageError> {
    let mut bytes = bytes.strip_prefix(&MARK).ok_or(MessageError::Foreign)?;
    let version = bytes.try_get_u8().or(Err(MessageError::Foreign))?;
    if !(FIRST_VERSION..=VERSION).contains(&version) {
        return Err(MessageError::Version(version));
    }
    let compares = match bytes.try_get_u8() {
        Ok(flag @ (0 | 1)) => flag == 1,
        _ => return Err(MessageError::Malformed),
    };
    let origin = origin(&mut bytes).ok_or(MessageError::Malformed)?;
    if version == WITH_NOTICE {
        let notice = Notice::decode(&mut bytes).filter(|_| bytes.is_empty());
        let notice = Some(notice.ok_or(MessageError::Malformed)?);
        return Ok(Message { origin, compares, deadline: None, notice, steps: Vec::new() });
    }
    let deadline = match version {
        WITH_DEADLINE => Some(bytes.try_get_i64_le().or(Err(MessageError::Malformed))?),
        _ => None,
    };
    let mut steps = Vec::new();
    while !bytes.is_empty() {
        let step = step(&mut bytes).ok_or(MessageError::Malformed)?;
        let index = steps.len();
        let step =
            encoding::decode(step, members).map_err(|error| MessageError::Step { index, error })?;
        steps.push(step);
    }
    Ok(Message { origin, compares, deadline, notice: None, steps })
}

fn origin(bytes: &mut &[u8]) -> Option<Origin> {
    let len = bytes.try_get_u8().ok()?;
    let node = str::from_utf8(bytes.split_off(..usize::from(len))?).ok()?;
    let node = is_word(node).then(|| node.to_owned())?;
    let (start, counter) = (bytes.try_get_u64_le().ok()?, bytes.try_get_u64_le().ok()?);
    Some(Origin { node, start, counter })
}

fn step<'a>(bytes: &mut &'a [u8]) -> Option<&'a [u8]> {
    let len = bytes.try_get_u32_le().ok()?;
    bytes.split_off(..len as usize)
}

#[cfg(test)]
mod tests {
    use holdfast_memory::{Access, Action, Area, Layout, Span};
    use proptest::prelude::*;

    use super::*;

    fn members() -> Vec<Arc<Memory>> {
        let span = Span::new(0, 10).unwrap();
        let layout = Layout::default().with(Area::HoldingRegisters, span);
        vec![Arc::new(Memory::new(layout, None).unwrap())]
    }

    fn mask(address: u16) -> Step {
        let area = Area::HoldingRegisters;
        let action = Action::Mask { member: 0, area, address, and_mask: 3, or_mask: 4 };
        Step { access: Access::Client, tenure: None, action }
    }

    fn encoded(origin: &Origin, compares: bool, deadline: Option<i64>, steps: &[Step]) -> Bytes {
        let steps: Vec<Vec<u8>> = steps
            .iter()
            .map(|step| {
                let mut bytes = Vec::new();
                encoding::encode(step, &mut bytes);
                bytes
            })
            .collect();
        encode(origin, compares, deadline, steps.iter().map(Vec::as_slice))
    }

    proptest! {
        #[test]
        fn a_message_is_decoded_as_it_was(
            node in "[a-zA-Z0-9_-]{1,64}",
            start: u64,
            counter: u64,
            compares: bool,
            deadline: Option<i64>,
            addresses in prop::collection::vec(0..10u16, 0..5),
        ) {
            let origin = Origin { node, start, counter };
            let steps: Vec<Step> = addresses.into_iter().map(mask).collect();
            let bytes = encoded(&origin, compares, deadline, &steps);
            let message = Message { origin, compares, deadline, notice: None, steps };
            prop_assert_eq!(decode(&bytes, &members()), Ok(message));
        }

        #[test]
        fn a_notice_is_decoded_as_it_was(compares: bool, kind in 0..3u8, sequence: u64) {
            let origin = Origin { node: "a".to_owned(), start: 1, counter: 2 };
            let notice = match kind {
                0 => Notice::Asks,
                1 => Notice::Answers { sequence },
                _ => Notice::Closes { behind: sequence },
            };
            let bytes = encode_notice(&origin, compares, notice);
            let (deadline, steps) = (None, Vec::new());
            let message = Message { origin, compares, deadline, notice: Some(notice), steps };
            prop_assert_eq!(decode(&bytes, &members()), Ok(message));
            let longer = [&bytes[..], b"\0"].concat();
            prop_assert_eq!(decode(&longer, &members()), Err(MessageError::Malformed));
        }

        #[test]
        fn any_bytes_are_a_message_or_an_error(
            version in prop::option::of(FIRST_VERSION..=VERSION),
            mut bytes in prop::collection::vec(any::<u8>(), 0..100),
        ) {
            if let Some(version) = version {
                bytes.splice(0..0, [&MARK[..], &[version], b"\x00\x01a"].concat());
            }
            let _ = decode(&bytes, &members());
        }

        #[test]
        fn changed_bytes_are_a_message_or_an_error(at in any::<prop::sample::Index>(), byte: u8) {
            let origin = Origin { node: "a".to_owned(), start: 1, counter: 2 };
            let mut bytes = encoded(&origin, false, Some(3), &[mask(1), mask(2)]).to_vec();
            let at = at.index(bytes.len());
            bytes[at] = byte;
            let _ = decode(&bytes, &members());
        }
    }

    #[test]
    fn bytes_of_others_are_distinguished_from_another_version() {
        let of = |bytes: &[u8]| decode(bytes, &members());
        assert_eq!(of(b"hello"), Err(MessageError::Foreign));
        assert_eq!(of(b"HFL\x05whatever"), Err(MessageError::Version(5)));
        assert_eq!(of(b"HFL\x01"), Err(MessageError::Malformed));
        let origin = Origin { node: "a".to_owned(), start: 1, counter: 2 };
        let error = of(&encoded(&origin, false, None, &[mask(1), mask(10)])).unwrap_err();
        assert!(matches!(error, MessageError::Step { index: 1, .. }), "{error}");
    }
}
