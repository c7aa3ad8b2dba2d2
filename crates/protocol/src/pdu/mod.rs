//! Protocol data units: a function code and its data, the same on every transport (V1.1b3, 4).

mod diagnostics;
mod function;
pub mod identification;
pub mod reply;
mod request;
mod response;

pub use diagnostics::{Diagnostics, SubFunction};
pub use function::{ExceptionCode, Function};
pub use request::{Range, Request};
pub use response::{Response, ResponseError};

/// The longest PDU, in bytes (V1.1b3, 4.1).
pub const MAX_LEN: usize = 253;

/// Room for one PDU of any kind.
pub type Buffer = [u8; MAX_LEN];

/// The most items of one request (V1.1b3, 6).
pub mod limit {
    pub const READ_BITS: u16 = 2000;
    pub const READ_REGISTERS: u16 = 125;
    pub const WRITE_BITS: u16 = 1968;
    pub const WRITE_REGISTERS: u16 = 123;
    /// Written by function 23, which carries a read beside the write.
    pub const READ_WRITE_REGISTERS: u16 = 121;
}
