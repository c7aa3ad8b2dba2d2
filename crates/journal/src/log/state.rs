//! What the messages of a log lead to: contents, and what was applied of each origin. Equal on all
//! nodes after the same sequence.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use aws_lc_rs::digest::{SHA256, digest};
use bytes::Buf;
use holdfast_memory::{CarriedOut, Contents, Memory, Outcome, Refusal, Refused, Step};
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

use super::error::LogError;
use super::late_messages::is_late;
use super::lease_terms::LeaseTerms;
use super::settings::is_word;
use crate::log::stream::message::{
    self, FIRST_VERSION, MAX_NODES, Message, MessageError, Notice, Origin, VERSION, WITH_LEASES,
};

/// An encoded state begins with it.
const MARK: [u8; 3] = *b"HFS";

#[derive(Debug)]
pub(super) struct State {
    pub(super) members: Vec<Arc<Memory>>,
    pub(super) position: StreamPosition,
    /// How many steps were applied since the log began.
    pub(super) steps: u64,
    /// The start and the last counter that were applied of each node.
    pub(super) origins: BTreeMap<String, (u64, u64)>,
    pub(super) terms: LeaseTerms,
}

/// A message of the stream.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct StreamPosition {
    /// 0 before the first message.
    pub(super) sequence: u64,
    /// When the stream has stored it, in nanoseconds of Unix time.
    pub(super) stored: i64,
}

impl fmt::Display for StreamPosition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Seconds suffice for people.
        let stored = OffsetDateTime::from_unix_timestamp(self.stored.div_euclid(1_000_000_000));
        let stored = stored.ok().and_then(|stored| stored.format(&Rfc3339).ok());
        write!(f, "sequence {} ({})", self.sequence, stored.as_deref().unwrap_or("no time"))
    }
}

/// What a message has done.
#[derive(Debug)]
pub(super) enum Applied {
    Fresh {
        origin: Origin,
        compares: bool,
        notice: Option<Notice>,
        outcomes: Vec<Outcome>,
        /// The memories whose seal it has closed.
        sealed: Vec<u16>,
    },
    /// It was applied before, or a later one of the same node was.
    Stale(Origin),
    /// It is of no node, of another log, or of a node for which the log has no room.
    Ignored(MessageError),
}

impl State {
    /// The state before the first message, with the contents that the memories have.
    pub(super) fn new(members: Vec<Arc<Memory>>) -> State {
        State {
            members,
            position: StreamPosition::default(),
            steps: 0,
            origins: BTreeMap::new(),
            terms: LeaseTerms::default(),
        }
    }

    /// Whether a message of this node was applied.
    pub(super) fn knows(&self, node: &str) -> bool {
        self.origins.contains_key(node)
    }

    /// Whether a node other than this one has ever sent a message.
    pub(super) fn knows_others(&self, node: &str) -> bool {
        self.origins.keys().any(|known| known != node)
    }

    /// Whether a seal that opens once is open.
    pub(super) fn has_open_seal(&self) -> bool {
        self.members.iter().any(|memory| memory.is_open_once())
    }

    /// Whether messages of this node are applied: the state of the log would grow for ever with new nodes.
    pub(super) fn has_room_for(&self, node: &str) -> bool {
        self.origins.len() < MAX_NODES || self.knows(node)
    }

    /// The last start of a node that was applied.
    pub(super) fn last_start(&self, node: &str) -> u64 {
        self.origins.get(node).map_or(0, |(start, _)| *start)
    }

    /// The last counter that was applied of this start of a node.
    pub(super) fn last_counter(&self, node: &str, start: u64) -> u64 {
        let last = self.origins.get(node);
        last.filter(|(applied, _)| *applied == start).map_or(0, |(_, counter)| *counter)
    }

    /// Applies the next message. `age` is how old the values of a device are in it, at most; `None` if that
    /// is not known.
    ///
    /// # Errors
    /// [`LogError::Version`]: this node can't know what the message does.
    pub(super) fn apply(
        &mut self,
        position: StreamPosition,
        payload: &[u8],
        age: impl FnOnce(&Origin) -> Option<Duration>,
    ) -> Result<Applied, LogError> {
        debug_assert_eq!(
            position.sequence,
            self.position.sequence + 1,
            "messages are applied in order"
        );
        let Message { origin, compares, deadline, notice, steps } =
            match message::decode(payload, &self.members) {
                Ok(message) => message,
                Err(MessageError::Version(found)) => {
                    let what = "a message of the log";
                    return Err(LogError::Version { what, found, supported: VERSION });
                }
                Err(error) => return Ok(self.ignore(position, error)),
            };
        self.position = position;
        // A message that was sent again, or one that a later start of its node has overtaken.
        let now = (origin.start, origin.counter);
        if self.origins.get(&origin.node).is_some_and(|last| *last >= now) {
            return Ok(Applied::Stale(origin));
        }
        // All nodes have the same origins, so all ignore it.
        if !self.has_room_for(&origin.node) {
            return Ok(Applied::Ignored(MessageError::TooManyNodes));
        }
        self.origins.insert(origin.node.clone(), now);
        self.steps += steps.len() as u64;
        let at = |done| CarriedOut { sequence: Some(position.sequence), ..done };
        let age = age(&origin);
        let is_late = is_late(position.stored, deadline);
        let carried_out = |step: &Step| {
            self.terms.admit(step.tenure)?;
            if is_late {
                return Err(Refused { index: 0, refusal: Refusal::NotConfirmed });
            }
            step.carry_out_late(&self.members, age).map(at)
        };
        let outcomes = steps.iter().map(carried_out).collect();
        let sealed = match notice {
            // What came between may be an answer, or seals that were closed and opened again.
            Some(Notice::Closes { behind }) if behind.checked_add(1) == Some(position.sequence) => {
                self.close_seals()
            }
            _ => Vec::new(),
        };
        Ok(Applied::Fresh { origin, compares, notice, outcomes, sealed })
    }

    /// Passes over the next message. It has a place in the order all the same: all nodes ignore it there.
    pub(super) fn ignore(&mut self, position: StreamPosition, error: MessageError) -> Applied {
        self.position = position;
        Applied::Ignored(error)
    }

    /// Closes the seals that open once. Returns whose were open.
    fn close_seals(&self) -> Vec<u16> {
        let numbered = (0..).zip(&self.members);
        numbered.filter(|(_, memory)| memory.close_seal()).map(|(member, _)| member).collect()
    }

    /// The version of the encoded state.
    pub(super) fn version(&self) -> u8 {
        if self.terms.is_empty() { FIRST_VERSION } else { WITH_LEASES }
    }

    /// How long the contents are.
    pub(super) fn contents_bytes(&self) -> u64 {
        let lens = self.members.iter().flat_map(|memory| memory.layout().byte_lens());
        lens.map(|len| len as u64).sum()
    }

    pub(super) fn encode(&self) -> Vec<u8> {
        let contents = Memory::contents(&self.members);
        let len: usize =
            contents.iter().flat_map(|contents| &contents.areas).map(|area| area.len() + 8).sum();
        let mut out =
            Vec::with_capacity(len + 64 + self.origins.len() * 96 + self.terms.len() * 24);
        out.extend_from_slice(&MARK);
        out.push(self.version());
        out.extend_from_slice(&self.position.sequence.to_le_bytes());
        out.extend_from_slice(&self.position.stored.to_le_bytes());
        out.extend_from_slice(&self.steps.to_le_bytes());
        out.extend_from_slice(&(self.origins.len() as u32).to_le_bytes());
        for (node, (start, counter)) in &self.origins {
            out.push(node.len() as u8);
            out.extend_from_slice(node.as_bytes());
            out.extend_from_slice(&start.to_le_bytes());
            out.extend_from_slice(&counter.to_le_bytes());
        }
        if !self.terms.is_empty() {
            self.terms.encode(&mut out);
        }
        out.extend_from_slice(&(contents.len() as u32).to_le_bytes());
        for Contents { areas, sealed } in &contents {
            out.push(u8::from(*sealed));
            for area in areas {
                out.extend_from_slice(&(area.len() as u32).to_le_bytes());
                out.extend_from_slice(area);
            }
        }
        out
    }

    /// Puts an encoded state in place of this one, if it fits the memories and is of this place.
    ///
    /// # Errors
    /// [`LogError::Version`], or [`LogError::Snapshot`]. Nothing has changed then.
    pub(super) fn load(&mut self, bytes: &[u8], expected: StreamPosition) -> Result<(), LogError> {
        let malformed = || LogError::Snapshot("the snapshot of the log is malformed".to_owned());
        let bytes = bytes.strip_prefix(&MARK).ok_or_else(malformed)?;
        let (&found, mut rest) = bytes.split_first().ok_or_else(malformed)?;
        if !(FIRST_VERSION..=WITH_LEASES).contains(&found) {
            let what = "the snapshot of the log";
            return Err(LogError::Version { what, found, supported: WITH_LEASES });
        }
        let loaded = loaded(&mut rest, found, &self.members).filter(|_| rest.is_empty());
        let Loaded { position, steps, origins, terms, contents } = loaded.ok_or_else(malformed)?;
        if position != expected {
            let sequence = expected.sequence;
            let text = format!("the snapshot at sequence {sequence}: it has another sequence");
            return Err(LogError::Snapshot(text));
        }
        for (memory, contents) in self.members.iter().zip(&contents) {
            memory.restore(contents);
        }
        (self.position, self.steps) = (position, steps);
        (self.origins, self.terms) = (origins, terms);
        Ok(())
    }
}

/// The SHA-256 of an encoded state, as text.
pub(super) fn digest_of(encoded: &[u8]) -> String {
    let digest = digest(&SHA256, encoded);
    digest.as_ref().iter().map(|byte| format!("{byte:02x}")).collect()
}

struct Loaded {
    position: StreamPosition,
    steps: u64,
    origins: BTreeMap<String, (u64, u64)>,
    terms: LeaseTerms,
    contents: Vec<Contents>,
}

/// Takes an encoded state for these memories.
fn loaded(bytes: &mut &[u8], version: u8, members: &[Arc<Memory>]) -> Option<Loaded> {
    let sequence = bytes.try_get_u64_le().ok()?;
    let position = StreamPosition { sequence, stored: bytes.try_get_i64_le().ok()? };
    let steps = bytes.try_get_u64_le().ok()?;
    let mut origins = BTreeMap::new();
    for _ in 0..bytes.try_get_u32_le().ok()? {
        let len = bytes.try_get_u8().ok()?;
        let node = str::from_utf8(bytes.split_off(..usize::from(len))?).ok()?;
        let node = is_word(node).then(|| node.to_owned())?;
        origins.insert(node, (bytes.try_get_u64_le().ok()?, bytes.try_get_u64_le().ok()?));
    }
    let has_leases = version == WITH_LEASES;
    let terms = if has_leases { LeaseTerms::decode(bytes)? } else { LeaseTerms::default() };
    if bytes.try_get_u32_le().ok()? as usize != members.len() {
        return None;
    }
    let contents = members.iter().map(|memory| contents(bytes, memory)).collect::<Option<_>>()?;
    Some(Loaded { position, steps, origins, terms, contents })
}

/// Takes the contents of a memory.
fn contents(bytes: &mut &[u8], memory: &Memory) -> Option<Contents> {
    let sealed = match bytes.try_get_u8().ok()? {
        0 => false,
        1 if memory.gate().is_some() => true,
        _ => return None,
    };
    let area = |expected: usize| {
        let fits = bytes.try_get_u32_le().ok()? as usize == expected;
        fits.then(|| bytes.split_off(..expected)).flatten().map(Box::from)
    };
    let areas = memory.layout().byte_lens().into_iter().map(area).collect::<Option<_>>()?;
    Some(Contents { areas, sealed })
}

#[cfg(test)]
mod tests {
    use holdfast_memory::{
        Access, Action, Area, Gate, GateMode, Layout, Span, StepWrite, Tenure, Term, Write,
    };

    use super::*;
    use crate::encoding;

    fn member() -> Arc<Memory> {
        let layout = Layout::default().with(Area::Coils, Span::new(0, 8).unwrap());
        Arc::new(Memory::new(layout, None).unwrap())
    }

    #[test]
    fn a_state_of_another_place_changes_nothing() {
        let (from, into) = (member(), member());
        let mut contents = Memory::contents(std::slice::from_ref(&from)).remove(0);
        contents.areas[0][0] = 1;
        from.restore(&contents);
        let position = StreamPosition { sequence: 7, stored: 1 };
        let saved = State { position, ..State::new(vec![from]) }.encode();
        let mut state = State::new(vec![into]);
        let before = state.encode();
        let error = state.load(&saved, StreamPosition { sequence: 8, stored: 1 }).unwrap_err();
        assert!(error.to_string().contains("sequence 8: it has another sequence"));
        assert_eq!(state.encode(), before);
        state.load(&saved, position).unwrap();
        assert_eq!(state.encode(), saved);
    }

    #[test]
    fn a_state_without_leases_is_read_by_older_nodes() {
        let mut state = State::new(vec![member()]);
        assert_eq!(state.encode()[3], FIRST_VERSION);
        let tenure = |epoch, since| Some(Tenure { lease: 7, term: Term { epoch, since } });
        state.terms.admit(None).unwrap();
        assert_eq!(state.version(), FIRST_VERSION);
        state.terms.admit(tenure(1, 5)).unwrap();
        let saved = state.encode();
        assert_eq!(saved[3], WITH_LEASES);
        let mut loaded = State::new(vec![member()]);
        loaded.load(&saved, state.position).unwrap();
        assert_eq!((loaded.encode(), &loaded.terms), (saved, &state.terms));
        assert!(
            loaded.terms.admit(tenure(1, 4)).is_err() && loaded.terms.admit(tenure(0, 9)).is_err()
        );
        assert!(
            loaded.terms.admit(tenure(1, 5)).is_ok() && loaded.terms.admit(tenure(2, 1)).is_ok()
        );
        assert!(loaded.terms.admit(tenure(1, 9)).is_err());
    }

    #[test]
    fn steps_that_the_stream_stored_behind_their_deadline_are_refused() {
        let mut state = State::new(vec![member()]);
        let mut apply = |sequence: u64, stored, deadline, coils: u8| {
            let (member, area, bytes) = (0, Area::Coils, vec![coils]);
            let write = StepWrite { member, area, address: 0, count: 8, bytes };
            let action = Action::Write(vec![write]);
            let mut step = Vec::new();
            encoding::encode(&Step { access: Access::Client, tenure: None, action }, &mut step);
            let origin = Origin { node: "a".to_owned(), start: 1, counter: sequence };
            let payload = message::encode(&origin, false, deadline, [&step[..]].into_iter());
            let position = StreamPosition { sequence, stored };
            let Applied::Fresh { outcomes, .. } =
                state.apply(position, &payload, |_| None).unwrap()
            else {
                panic!("it is fresh");
            };
            let outcome = outcomes[0].clone().map(|_| ()).map_err(|refused| refused.refusal);
            (outcome, Memory::contents(&state.members)[0].areas[0][0])
        };
        assert_eq!(apply(1, 500, Some(500), 1), (Ok(()), 1));
        assert_eq!(apply(2, 501, Some(500), 2), (Err(Refusal::NotConfirmed), 1));
        assert_eq!(apply(3, 502, None, 3), (Ok(()), 3), "of an older node");
        assert_eq!(state.last_counter("a", 1), 3);
    }

    #[test]
    fn seals_are_closed_only_directly_behind_the_message_that_the_node_has_applied_last() {
        let gate = |mode| Gate { area: Area::Coils, address: 3, mode };
        let layout = Layout::default().with(Area::Coils, Span::new(0, 8).unwrap());
        let gates = [Some(gate(GateMode::Once)), Some(gate(GateMode::Level)), None];
        let members = gates.map(|gate| Arc::new(Memory::new(layout.clone(), gate).unwrap()));
        for memory in &members {
            let write = Write { area: Area::Coils, address: 0, count: 8, bytes: &[0xff] };
            memory.write(Access::Ingest, write).unwrap();
        }
        let mut state = State::new(members.to_vec());
        let mut apply = |sequence, notice| {
            let origin = Origin { node: "a".to_owned(), start: 1, counter: sequence };
            let payload = message::encode_notice(&origin, false, notice);
            let position = StreamPosition { sequence, stored: 0 };
            let Applied::Fresh { sealed, .. } = state.apply(position, &payload, |_| None).unwrap()
            else {
                panic!("it is fresh");
            };
            let contents = Memory::contents(&state.members);
            (sealed, state.has_open_seal(), contents.iter().map(|of| of.areas[0][0]).collect())
        };
        let open = || (vec![], true, vec![0xff; 3]);
        assert_eq!(apply(1, Notice::Asks), open());
        assert_eq!(apply(2, Notice::Closes { behind: 0 }), open(), "something came between");
        assert_eq!(apply(3, Notice::Closes { behind: u64::MAX }), open());
        let closed = |sealed| (sealed, false, vec![0xf7, 0xff, 0xff]);
        assert_eq!(apply(4, Notice::Closes { behind: 3 }), closed(vec![0]));
        assert_eq!(apply(5, Notice::Closes { behind: 4 }), closed(vec![]), "it was closed");
        assert!(members[0].sealed() && !members[1].sealed());
        assert_eq!(members[0].seal_changes(), (1, 1));
    }

    #[test]
    fn a_position_is_shown_with_its_time() {
        for (seconds, expected) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_827_696, "2000-02-29T12:34:56Z"),
            (1_767_225_599, "2025-12-31T23:59:59Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
            (-1, "1969-12-31T23:59:59Z"),
        ] {
            let position = StreamPosition { sequence: 7, stored: seconds * 1_000_000_000 };
            assert_eq!(position.to_string(), format!("sequence 7 ({expected})"));
        }
    }
}
