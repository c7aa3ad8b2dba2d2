//! What requests ask of a memory, and the exceptions that its refusals become.

use holdfast_memory::{Area, Memory, Read, Refusal, Write};
use holdfast_protocol::pdu::{ExceptionCode, Range};

#[inline]
pub(in crate::server) fn reading<const MAX: u16>(
    area: Area,
    range: Range<MAX>,
    out: &mut [u8],
) -> Read<'_> {
    Read { area, address: range.address(), count: usize::from(range.quantity()), out }
}

#[inline]
pub(in crate::server) fn writing(area: Area, address: u16, count: u16, bytes: &[u8]) -> Write<'_> {
    Write { area, address, count: usize::from(count), bytes }
}

#[cold]
pub(in crate::server) fn exception_of(refusal: Refusal) -> ExceptionCode {
    match refusal {
        Refusal::Sealed => ExceptionCode::ServerDeviceBusy,
        Refusal::OutOfRange | Refusal::GateBit | Refusal::Mirrored => {
            ExceptionCode::IllegalDataAddress
        }
        Refusal::WrongLength | Refusal::NotRegisters => ExceptionCode::IllegalDataValue,
        Refusal::Stale => ExceptionCode::GatewayTargetFailedToRespond,
        Refusal::Unavailable | Refusal::Behind => ExceptionCode::ServerDeviceBusy,
        Refusal::NotStored | Refusal::NotConfirmed | Refusal::Differs => {
            ExceptionCode::ServerDeviceFailure
        }
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
