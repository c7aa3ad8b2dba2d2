//! The sub-functions of function 8, Diagnostics (V1.1b3, 6.8.1).

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
    /// The sub-function of a PDU of function 8, with any data field.
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
        match self {
            SubFunction::RestartCommunications
            | SubFunction::ChangeAsciiInputDelimiter
            | SubFunction::ForceListenOnlyMode
            | SubFunction::ClearCounters
            | SubFunction::ClearOverrunCounter => true,
            SubFunction::ReturnQueryData
            | SubFunction::ReturnDiagnosticRegister
            | SubFunction::ReturnBusMessageCount
            | SubFunction::ReturnBusCommunicationErrorCount
            | SubFunction::ReturnBusExceptionErrorCount
            | SubFunction::ReturnServerMessageCount
            | SubFunction::ReturnServerNoResponseCount
            | SubFunction::ReturnServerNakCount
            | SubFunction::ReturnServerBusyCount
            | SubFunction::ReturnBusCharacterOverrunCount => false,
        }
    }
}
