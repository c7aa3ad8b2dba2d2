//! Steps: writes that own their data, so that they can be stored, sent, and carried out later.
//!
//! What a step does depends only on the content of the memories: the same steps in the same order
//! lead to the same content and the same results, in every process.

use std::fmt;

use crate::area::Area;
use crate::error::{Refusal, Refused};
use crate::operation::{Access, Write};

/// A write with this access, to one memory or several.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Step {
    pub access: Access,
    /// Under which lease it was written, if that matters to the journal.
    pub tenure: Option<Tenure>,
    pub action: Action,
}

/// A lease under which a node writes what it reads from a device, while others may hold it before and after.
/// After a step of a later term, those of earlier ones are refused with [`Refusal::Overtaken`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tenure {
    /// The number of the lease, the same on all nodes.
    pub lease: u64,
    pub term: Term,
}

/// The time for which one node holds a lease. A later one is greater.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Term {
    /// Greater each time the counter of `since` begins anew.
    pub epoch: u64,
    /// Grows with each holder.
    pub since: u64,
}

/// What a step does. A member is the number of a memory in its journal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    /// Writes ranges. Where two overlap, the later one wins.
    Write(Vec<StepWrite>),
    /// Replaces a register by `(now AND and_mask) OR (or_mask AND NOT and_mask)`.
    Mask { member: u16, area: Area, address: u16, and_mask: u16, or_mask: u16 },
    /// Writes a range, then reads one of the same memory.
    WriteThenRead { write: StepWrite, area: Area, address: u16, count: usize },
}

/// A range to write, as a [`Write`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StepWrite {
    pub member: u16,
    pub area: Area,
    pub address: u16,
    pub count: usize,
    pub bytes: Vec<u8>,
}

/// A step that was carried out.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CarriedOut {
    /// The bytes that it read.
    pub read: Vec<u8>,
    /// Its place in a log that several nodes share.
    pub sequence: Option<u64>,
}

/// The result of a step. If it was refused, nothing was written.
pub type Outcome = Result<CarriedOut, Refused>;

/// Receives the outcome of a step. A step whose receiver is dropped counts as
/// [`Refusal::NotConfirmed`].
pub type Done = Box<dyn FnOnce(Outcome) + Send>;

/// Carries out the writes to its memories, in one order, and keeps them.
pub trait Journal: fmt::Debug + Send + Sync {
    /// Takes a step that is valid for its memories, without waiting. `done` is called from any thread,
    /// also before this returns.
    ///
    /// Besides the refusals of a memory, the outcome may be [`Refusal::Unavailable`],
    /// [`Refusal::Busy`], [`Refusal::TooLarge`], [`Refusal::NotStored`], [`Refusal::NotConfirmed`] or
    /// [`Refusal::Overtaken`].
    fn submit(&self, step: Step, done: Done);

    /// Whether [`Journal::admit`] is asked before each access: several nodes share the contents. It stays
    /// the same.
    fn guards(&self) -> bool {
        false
    }

    /// Whether the memories may be read and written now. Called with the lock of a memory, for each
    /// read.
    ///
    /// # Errors
    /// [`Refusal::Behind`] or [`Refusal::Differs`].
    fn admit(&self) -> Result<(), Refusal> {
        Ok(())
    }
}

/// A write to one memory that is carried out later.
#[derive(Debug, Clone, Copy)]
pub enum Operation<'a> {
    /// Where two overlap, the later one wins.
    Write(&'a [Write<'a>]),
    Mask {
        area: Area,
        address: u16,
        and_mask: u16,
        or_mask: u16,
    },
    WriteThenRead {
        write: Write<'a>,
        area: Area,
        address: u16,
        count: usize,
    },
}

impl StepWrite {
    pub(crate) fn new(member: u16, write: &Write<'_>) -> StepWrite {
        let Write { area, address, count, bytes } = *write;
        StepWrite { member, area, address, count, bytes: bytes.to_vec() }
    }

    pub(crate) fn borrowed(&self) -> Write<'_> {
        let StepWrite { area, address, count, ref bytes, .. } = *self;
        Write { area, address, count, bytes }
    }
}

/// Submits a step and waits for its outcome.
pub(crate) fn wait(submit: impl FnOnce(Done) -> Result<(), Refused>) -> Outcome {
    let (sender, receiver) = std::sync::mpsc::sync_channel(1);
    submit(Box::new(move |outcome| {
        // Never fails: the receiver below waits without a limit.
        let _ = sender.send(outcome);
    }))?;
    receiver.recv().unwrap_or(Err(Refused { index: 0, refusal: Refusal::NotConfirmed }))
}
