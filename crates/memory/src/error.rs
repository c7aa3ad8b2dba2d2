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
    #[error("the range is outside the area")]
    OutOfRange,
    #[error("the gate bit can't be written by a client")]
    GateBit,
    #[error("the range has no items, or the number of bytes does not match it")]
    WrongLength,
    #[error("the range mirrors a device")]
    Mirrored,
    #[error("only registers can be masked")]
    NotRegisters,
}

/// One operation of a batch was refused, so none of the batch was carried out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("operation {index}: {refusal}")]
pub struct Refused {
    /// The index of the refused operation, from 0.
    pub index: usize,
    pub refusal: Refusal,
}
