//! Function 8, Diagnostics: its sub-functions and their data (V1.1b3, 6.8.1).

use super::ExceptionCode;

/// A sub-function of Diagnostics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u16)]
pub enum SubFunction {
    ReturnQueryData = 0x00,
    RestartCommunications = 0x01,
    ReturnDiagnosticRegister = 0x02,
    ChangeAsciiInputDelimiter = 0x03,
    ForceListenOnlyMode = 0x04,
    ClearCounters = 0x0A,
    ReturnBusMessageCount = 0x0B,
    ReturnBusCommunicationErrorCount = 0x0C,
    ReturnBusExceptionErrorCount = 0x0D,
    ReturnServerMessageCount = 0x0E,
    ReturnServerNoResponseCount = 0x0F,
    ReturnServerNakCount = 0x10,
    ReturnServerBusyCount = 0x11,
    ReturnBusCharacterOverrunCount = 0x12,
    ClearOverrunCounter = 0x14,
}

impl SubFunction {
    const ALL: [SubFunction; 15] = [
        SubFunction::ReturnQueryData,
        SubFunction::RestartCommunications,
        SubFunction::ReturnDiagnosticRegister,
        SubFunction::ChangeAsciiInputDelimiter,
        SubFunction::ForceListenOnlyMode,
        SubFunction::ClearCounters,
        SubFunction::ReturnBusMessageCount,
        SubFunction::ReturnBusCommunicationErrorCount,
        SubFunction::ReturnBusExceptionErrorCount,
        SubFunction::ReturnServerMessageCount,
        SubFunction::ReturnServerNoResponseCount,
        SubFunction::ReturnServerNakCount,
        SubFunction::ReturnServerBusyCount,
        SubFunction::ReturnBusCharacterOverrunCount,
        SubFunction::ClearOverrunCounter,
    ];

    pub fn from_code(code: u16) -> Option<SubFunction> {
        SubFunction::ALL.into_iter().find(|sub_function| sub_function.code() == code)
    }

    pub const fn code(self) -> u16 {
        self as u16
    }

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
