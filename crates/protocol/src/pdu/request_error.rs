//! Errors of invalid requests.

use thiserror::Error;

use super::{SubFunction, limit};

/// Why a request is invalid.
///
/// ```
/// use holdfast_protocol::pdu::BitRange;
///
/// let error = BitRange::new(0, 2001).unwrap_err();
/// assert_eq!(error.to_string(), "quantity is 2001, allowed: 1 to 2000");
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Error)]
#[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
pub enum RequestError {
    /// The quantity is 0, or beyond the limit of the function.
    #[error("quantity is {found}, allowed: 1 to {max}")]
    Quantity {
        /// The quantity that was given.
        found: usize,
        /// The limit of the function.
        max: u16,
    },
    /// The data does not have the length that its quantity requires.
    #[error("data has {found} bytes, {expected} are required")]
    Length {
        /// The length that was given, in bytes.
        found: usize,
        /// The length that is required, in bytes.
        expected: usize,
    },
    /// The file is 0.
    #[error("file is 0, allowed: 1 to 65535")]
    File,
    /// The record is above [`limit::LAST_RECORD`].
    #[error("record is {0}, allowed: 0 to {max}", max = limit::LAST_RECORD)]
    Record(u16),
    /// Ranges of files take no space, or more than a request or its reply has.
    #[error("the ranges take {found} bytes of a request or its reply, allowed: 1 to {max}")]
    Space {
        /// The bytes that they take.
        found: usize,
        /// The bytes that a request or its reply has for them.
        max: usize,
    },
    /// The sub-function of Diagnostics does not allow this data field.
    #[error("{} does not allow this data field", .0.name())]
    Data(SubFunction),
}
