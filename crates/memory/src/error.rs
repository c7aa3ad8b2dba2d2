//! Why an operation was refused. A refusal means that nothing has changed.

use thiserror::Error;

/// A span or gate that no memory can have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum LayoutError {
    #[error("start {start} and size {size} reach beyond address 65535")]
    TooLarge { start: u16, size: u32 },
    #[error("the gate bit must be in coils or discrete_inputs")]
    GateNotABit,
    #[error("the gate bit {address} is outside its area")]
    GateOutside { address: u16 },
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
    #[error("there are no items, or the number of bytes does not fit them")]
    WrongLength,
    #[error("only registers can be masked")]
    NotRegisters,
}

/// A refusal of one of several operations: none of them has been carried out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("operation {index}: {refusal}")]
pub struct Refused {
    /// Which operation, counted from 0.
    pub index: usize,
    pub refusal: Refusal,
}
