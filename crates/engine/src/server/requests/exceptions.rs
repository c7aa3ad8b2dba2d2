//! The exceptions for what a peer may not do, and for what a memory refuses.

use holdfast_memory::{Memory, Refusal};
use holdfast_protocol::pdu::ExceptionCode;

/// The exception for what a peer may not do: for a peer that may only read, a write is no function.
pub(crate) const NOT_ALLOWED: ExceptionCode = ExceptionCode::IllegalFunction;

#[cold]
pub(in crate::server) fn exception_of(refusal: Refusal) -> ExceptionCode {
    match refusal {
        Refusal::Sealed => ExceptionCode::ServerDeviceBusy,
        Refusal::OutOfRange | Refusal::GateBit | Refusal::Mirrored => {
            ExceptionCode::IllegalDataAddress
        }
        Refusal::WrongLength | Refusal::NotRegisters => ExceptionCode::IllegalDataValue,
        Refusal::Stale | Refusal::Overtaken => ExceptionCode::GatewayTargetFailedToRespond,
        Refusal::Unavailable | Refusal::Busy | Refusal::Behind => ExceptionCode::ServerDeviceBusy,
        Refusal::TooLarge { .. }
        | Refusal::NotStored
        | Refusal::NotConfirmed
        | Refusal::Differs => ExceptionCode::ServerDeviceFailure,
        Refusal::NotOneStep => unreachable!("a request writes to one memory"),
        Refusal::Unsealed => unreachable!("clients never restore"),
    }
}

/// The refusal of a request outside the ranges of a peer: a sealed memory is busy for every request.
pub(in crate::server) fn out_of_ranges(memory: &Memory) -> ExceptionCode {
    if memory.sealed() {
        ExceptionCode::ServerDeviceBusy
    } else {
        ExceptionCode::IllegalDataAddress
    }
}
