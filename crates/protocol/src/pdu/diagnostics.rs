//! Function 8, Diagnostics: a sub-function and its data (V1.1b3, 6.8).

use super::{ExceptionCode, MAX_LEN, RequestError, SubFunction};

/// The longest data field, in bytes.
const MAX_DATA_LEN: usize = MAX_LEN - 3;

/// A sub-function and a data field that the standard allows for it.
///
/// ```
/// use holdfast_protocol::pdu::{Diagnostics, Request, RequestError, SubFunction};
///
/// let request = Request::Diagnostics(Diagnostics::new(SubFunction::ReturnQueryData, &[1, 2])?);
/// let refused = Diagnostics::new(SubFunction::ClearCounters, &[1, 2]);
/// assert_eq!(refused, Err(RequestError::Data(SubFunction::ClearCounters)));
/// # Ok::<(), RequestError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Diagnostics<'a> {
    sub_function: SubFunction,
    data: &'a [u8],
}

impl<'a> Diagnostics<'a> {
    /// A sub-function with its data field: 1 to 125 words of any value for
    /// [`SubFunction::ReturnQueryData`], one word for all others. That word is `FF00` or `0000` for
    /// [`SubFunction::RestartCommunications`], a character of 7 bits and `00` for
    /// [`SubFunction::ChangeAsciiInputDelimiter`], else `0000`.
    ///
    /// # Errors
    /// [`RequestError::Data`] for any other data field.
    #[inline]
    pub const fn new(
        sub_function: SubFunction,
        data: &'a [u8],
    ) -> Result<Diagnostics<'a>, RequestError> {
        let valid = match sub_function {
            SubFunction::ReturnQueryData => {
                !data.is_empty() && data.len().is_multiple_of(2) && data.len() <= MAX_DATA_LEN
            }
            SubFunction::RestartCommunications => matches!(data, [0x00 | 0xFF, 0x00]),
            SubFunction::ChangeAsciiInputDelimiter => matches!(data, [0x00..=0x7F, 0x00]),
            _ => matches!(data, [0x00, 0x00]),
        };
        if valid {
            Ok(Diagnostics { sub_function, data })
        } else {
            Err(RequestError::Data(sub_function))
        }
    }

    /// The sub-function.
    #[inline]
    pub const fn sub_function(&self) -> SubFunction {
        self.sub_function
    }

    /// The data field.
    #[inline]
    pub const fn data(&self) -> &'a [u8] {
        self.data
    }

    #[inline]
    pub(super) fn parse(body: &'a [u8]) -> Result<Diagnostics<'a>, ExceptionCode> {
        let [high, low, data @ ..] = body else {
            return Err(ExceptionCode::IllegalDataValue);
        };
        let sub_function = SubFunction::from_code(u16::from_be_bytes([*high, *low]))
            .ok_or(ExceptionCode::IllegalFunction)?;
        Diagnostics::new(sub_function, data).or(Err(ExceptionCode::IllegalDataValue))
    }
}
