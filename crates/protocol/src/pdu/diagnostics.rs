//! Function 8, Diagnostics: its sub-functions and their data (V1.1b3, 6.8.1).

use super::ExceptionCode;

codes! {
    /// A sub-function of Diagnostics.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
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
    /// Whether it changes how the server behaves or what it counts, not only what it answers.
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

/// A sub-function and its data field: whole words for Return Query Data, else one word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Diagnostics<'a> {
    pub sub_function: SubFunction,
    pub data: &'a [u8],
}

impl<'a> Diagnostics<'a> {
    /// The sub-function of a PDU of function 8, whatever its data field.
    pub fn sub_function(pdu: &[u8]) -> Option<SubFunction> {
        let high_low = pdu.get(1..)?.first_chunk::<2>()?;
        SubFunction::from_code(u16::from_be_bytes(*high_low))
    }

    pub(super) fn parse(body: &'a [u8]) -> Result<Diagnostics<'a>, ExceptionCode> {
        let [high, low, data @ ..] = body else {
            return Err(ExceptionCode::IllegalDataValue);
        };
        let sub_function = SubFunction::from_code(u16::from_be_bytes([*high, *low]))
            .ok_or(ExceptionCode::IllegalFunction)?;
        let valid = match sub_function {
            SubFunction::ReturnQueryData => !data.is_empty() && data.len().is_multiple_of(2),
            SubFunction::RestartCommunications => matches!(data, [0x00 | 0xFF, 0x00]),
            SubFunction::ChangeAsciiInputDelimiter => matches!(data, [0x00..=0x7F, 0x00]),
            _ => matches!(data, [0x00, 0x00]),
        };
        if valid {
            Ok(Diagnostics { sub_function, data })
        } else {
            Err(ExceptionCode::IllegalDataValue)
        }
    }
}
