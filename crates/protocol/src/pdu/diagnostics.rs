//! Function 8, Diagnostics: its sub-functions and their data (V1.1b3, 6.8.1).

use super::{ExceptionCode, MAX_LEN, RequestError};

codes! {
    /// A sub-function of Diagnostics.
    ///
    /// ```
    /// use holdfast_protocol::pdu::SubFunction;
    ///
    /// assert_eq!(SubFunction::from_code(0x0A), Some(SubFunction::ClearCounters));
    /// assert_eq!(SubFunction::ClearCounters.name(), "Clear Counters and Diagnostic Register");
    /// assert_eq!(SubFunction::from_code(0x13), None);
    /// ```
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
    #[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
    SubFunction: u16 {
        ReturnQueryData = 0x00, "Return Query Data";
        RestartCommunications = 0x01, "Restart Communications Option";
        ReturnDiagnosticRegister = 0x02, "Return Diagnostic Register";
        ChangeAsciiInputDelimiter = 0x03, "Change ASCII Input Delimiter";
        ForceListenOnlyMode = 0x04, "Force Listen Only Mode";
        ClearCounters = 0x0A, "Clear Counters and Diagnostic Register";
        ReturnBusMessageCount = 0x0B, "Return Bus Message Count";
        ReturnBusCommunicationErrorCount = 0x0C, "Return Bus Communication Error Count";
        ReturnBusExceptionErrorCount = 0x0D, "Return Bus Exception Error Count";
        ReturnServerMessageCount = 0x0E, "Return Server Message Count";
        ReturnServerNoResponseCount = 0x0F, "Return Server No Response Count";
        ReturnServerNakCount = 0x10, "Return Server NAK Count";
        ReturnServerBusyCount = 0x11, "Return Server Busy Count";
        ReturnBusCharacterOverrunCount = 0x12, "Return Bus Character Overrun Count";
        ClearOverrunCounter = 0x14, "Clear Overrun Counter and Flag";
    }
}

impl SubFunction {
    /// The sub-function of a PDU of function 8, whatever its data field.
    ///
    /// ```
    /// use holdfast_protocol::pdu::SubFunction;
    ///
    /// let sub_function = SubFunction::from_pdu(&[8, 0x00, 0x04]);
    /// assert_eq!(sub_function, Some(SubFunction::ForceListenOnlyMode));
    /// ```
    pub fn from_pdu(pdu: &[u8]) -> Option<SubFunction> {
        let high_low = pdu.get(1..)?.first_chunk::<2>()?;
        SubFunction::from_code(u16::from_be_bytes(*high_low))
    }

    /// Whether the sub-function changes how the server behaves or what it counts.
    pub const fn changes_state(self) -> bool {
        matches!(
            self,
            SubFunction::RestartCommunications
                | SubFunction::ChangeAsciiInputDelimiter
                | SubFunction::ForceListenOnlyMode
                | SubFunction::ClearCounters
                | SubFunction::ClearOverrunCounter
        )
    }
}

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
