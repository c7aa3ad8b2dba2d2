//! Errors of memories. A refused operation changes nothing.

use thiserror::Error;

/// Why a span or a gate is invalid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum LayoutError {
    #[error("start {start} and size {size} reach beyond address 65535")]
    TooLarge { start: u16, size: u32 },
    #[error("the gate bit must be in coils or discrete_inputs")]
    GateNotABit,
    #[error("the gate bit {address} is outside its area")]
    GateOutside { address: u16 },
    #[error("the mirrored range from address {address} is empty or outside its area")]
    MirrorOutside { address: u16 },
}

/// Why an operation was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum Refusal {
    #[error("the memory is sealed")]
    Sealed,
    #[error("the memory is not sealed, and the source writes only while it is")]
    Unsealed,
    #[error("the range is outside the area")]
    OutOfRange,
    #[error("the gate bit can't be written by a client")]
    GateBit,
    #[error("the range has no items, or the number of bytes does not match it")]
    WrongLength,
    #[error("the range mirrors a device")]
    Mirrored,
    #[error("the range mirrors a device, and its values are older than allowed")]
    Stale,
    #[error("only registers can be masked")]
    NotRegisters,
    #[error("what keeps the memory can't be reached, and nothing was written")]
    Unavailable,
    #[error("too many writes wait to be stored, and this one was not carried out")]
    Busy,
    #[error("the step has {bytes} bytes, the log takes at most {most}")]
    TooLarge { bytes: usize, most: usize },
    #[error("the write can't be stored, and was not carried out")]
    NotStored,
    #[error("the write was sent, but not confirmed: it may still be carried out")]
    NotConfirmed,
    #[error("another node has written what the device holds since, and nothing was written")]
    Overtaken,
    #[error("the memory has had no contact with its log for too long")]
    Behind,
    #[error("the contents are not those that the log leads to")]
    Differs,
    #[error("the memories are not kept together, so they can't be written in one step")]
    NotOneStep,
}

/// One operation of a batch was refused, so none of the batch was carried out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("operation {index}: {refusal}")]
pub struct Refused {
    /// The index of the refused operation, from 0.
    pub index: usize,
    pub refusal: Refusal,
}

impl Refused {
    /// Why the only operation was refused.
    pub(crate) fn alone(self) -> Refusal {
        debug_assert_eq!(self.index, 0, "there is one operation");
        self.refusal
    }
}
