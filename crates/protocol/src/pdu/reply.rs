//! Replies, written by a server at the start of the buffer that is sent. Each function returns the
//! length of the PDU it wrote.

use super::{Buffer, ExceptionCode, Function, SubFunction};

/// The function code with its high bit set, and why (V1.1b3, 7).
pub fn exception(function_code: u8, code: ExceptionCode, pdu: &mut Buffer) -> usize {
    pdu[0] = function_code | 0x80;
    pdu[1] = code.code();
    2
}

/// The head of a reply that carries `len` bytes, up to 251, and the place for them, which the
/// caller fills (functions 1-4, 17, 23).
pub fn counted(function: Function, len: u8, pdu: &mut Buffer) -> (&mut [u8], usize) {
    pdu[0] = function.code();
    pdu[1] = len;
    let len = usize::from(len).min(pdu.len() - 2);
    (&mut pdu[2..2 + len], 2 + len)
}

/// The request, or its first bytes, sent back (functions 5, 6, 8, 15, 16, 22).
pub fn echo(request: &[u8], pdu: &mut Buffer) -> usize {
    let len = request.len().min(pdu.len());
    pdu[..len].copy_from_slice(&request[..len]);
    len
}

/// A counter or register of Diagnostics (function 8).
pub fn diagnostics(sub_function: SubFunction, data: u16, pdu: &mut Buffer) -> usize {
    pdu[0] = Function::Diagnostics.code();
    pdu[1..3].copy_from_slice(&sub_function.code().to_be_bytes());
    pdu[3..5].copy_from_slice(&data.to_be_bytes());
    5
}

/// Status (0: no program command is being processed) and event count (function 11).
pub fn event_counter(events: u16, pdu: &mut Buffer) -> usize {
    pdu[0] = Function::GetCommEventCounter.code();
    pdu[1..3].copy_from_slice(&[0, 0]);
    pdu[3..5].copy_from_slice(&events.to_be_bytes());
    5
}
