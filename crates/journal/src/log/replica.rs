//! A node without its servers: what the messages of a log make of memories.

use std::sync::Arc;

use holdfast_memory::{Memory, Step};

use super::error::LogError;
use super::state::{State, StreamPosition};
use super::stream::message::{self, Message};
use crate::encoding;

#[derive(Debug)]
pub struct Replica(State);

impl Replica {
    pub fn new(members: Vec<Arc<Memory>>) -> Replica {
        Replica(State::new(members))
    }

    /// Applies the next message.
    ///
    /// # Errors
    /// [`LogError::Version`]
    pub fn apply(&mut self, payload: &[u8]) -> Result<(), LogError> {
        let sequence = self.0.position.sequence + 1;
        self.0.apply(StreamPosition { sequence, stored: 0 }, payload, |_| None).map(drop)
    }

    /// What a snapshot has.
    pub fn encode(&self) -> Vec<u8> {
        self.0.encode()
    }

    /// Loads a snapshot that was taken here, or at this sequence.
    ///
    /// # Errors
    /// As those of a log.
    pub fn load(&mut self, snapshot: &[u8], sequence: u64) -> Result<(), LogError> {
        self.0.load(snapshot, StreamPosition { sequence, stored: 0 })
    }
}

/// A message, decoded and encoded again. `None`: these bytes are not a message for these memories.
pub fn again(payload: &[u8], members: &[Arc<Memory>]) -> Option<Vec<u8>> {
    let Message { origin, compares, deadline, notice, steps } =
        message::decode(payload, members).ok()?;
    if let Some(notice) = notice {
        return Some(message::encode_notice(&origin, compares, notice).to_vec());
    }
    let encoded = |step: &Step| {
        let mut bytes = Vec::new();
        encoding::encode(step, &mut bytes);
        bytes
    };
    let steps: Vec<Vec<u8>> = steps.iter().map(encoded).collect();
    Some(message::encode(&origin, compares, deadline, steps.iter().map(Vec::as_slice)).to_vec())
}
