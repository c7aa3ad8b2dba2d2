//! Protocol data units: a function code and its data, the same on every transport (V1.1b3, 4).
//!
//! | side | in | out |
//! | --- | --- | --- |
//! | server | [`Request::parse`] | [`reply`], one function for each kind of reply |
//! | client | [`Request::response`] | [`Request::encode`] |

mod data;
mod diagnostics;
mod encoded;
mod file;
mod function;
pub mod identification;
pub mod limit;
mod range;
pub mod reply;
mod request;
mod request_error;
mod request_length;
mod response;
mod sub_function;

pub use data::{Bits, Registers, pack_bits, pack_registers};
pub use diagnostics::Diagnostics;
pub use encoded::EncodedRequest;
pub use file::{FileAnswer, FileRange, FileRanges, FileRecords};
pub use function::{ExceptionCode, Function};
pub use range::{BitRange, Range, RegisterRange};
pub use request::Request;
pub use request_error::RequestError;
pub(crate) use request_length::{DataLen, request_data_len};
pub use request_length::{is_one_request, may_be_passed_on};
pub use response::{Response, ResponseError};
pub use sub_function::SubFunction;

/// The longest PDU, in bytes (V1.1b3, 4.1).
pub const MAX_LEN: usize = 253;

/// A buffer for one PDU of any kind.
pub type Buffer = [u8; MAX_LEN];
