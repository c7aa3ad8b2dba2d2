//! Function codes and exception codes (V1.1b3, 5.1 and 7).

use thiserror::Error;

codes! {
    /// A function that this crate can encode and decode.
    ///
    /// ```
    /// use holdfast_protocol::pdu::Function;
    ///
    /// let function = Function::from_code(16).unwrap();
    /// assert_eq!(function, Function::WriteMultipleRegisters);
    /// assert_eq!(function.name(), "Write Multiple Registers");
    /// assert!(function.is_write());
    /// ```
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
    #[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
    Function: u8 {
        ReadCoils = 1, "Read Coils";
        ReadDiscreteInputs = 2, "Read Discrete Inputs";
        ReadHoldingRegisters = 3, "Read Holding Registers";
        ReadInputRegisters = 4, "Read Input Registers";
        WriteSingleCoil = 5, "Write Single Coil";
        WriteSingleRegister = 6, "Write Single Register";
        ReadExceptionStatus = 7, "Read Exception Status";
        Diagnostics = 8, "Diagnostics";
        GetCommEventCounter = 11, "Get Comm Event Counter";
        GetCommEventLog = 12, "Get Comm Event Log";
        WriteMultipleCoils = 15, "Write Multiple Coils";
        WriteMultipleRegisters = 16, "Write Multiple Registers";
        ReportServerId = 17, "Report Server ID";
        ReadFileRecord = 20, "Read File Record";
        WriteFileRecord = 21, "Write File Record";
        MaskWriteRegister = 22, "Mask Write Register";
        ReadWriteMultipleRegisters = 23, "Read/Write Multiple Registers";
        ReadFifoQueue = 24, "Read FIFO Queue";
        /// Only MEI type 14, Read Device Identification.
        EncapsulatedInterface = 43, "Encapsulated Interface Transport";
    }
}

impl Function {
    /// The function of a PDU; `None` if it is empty, or of another function.
    #[inline]
    pub fn from_pdu(pdu: &[u8]) -> Option<Function> {
        Function::from_code(*pdu.first()?)
    }

    /// Whether the function changes coils, registers or files.
    pub const fn is_write(self) -> bool {
        match self {
            Function::WriteSingleCoil
            | Function::WriteSingleRegister
            | Function::WriteMultipleCoils
            | Function::WriteMultipleRegisters
            | Function::WriteFileRecord
            | Function::MaskWriteRegister
            | Function::ReadWriteMultipleRegisters => true,
            Function::ReadCoils
            | Function::ReadDiscreteInputs
            | Function::ReadHoldingRegisters
            | Function::ReadInputRegisters
            | Function::ReadExceptionStatus
            | Function::Diagnostics
            | Function::GetCommEventCounter
            | Function::GetCommEventLog
            | Function::ReportServerId
            | Function::ReadFileRecord
            | Function::ReadFifoQueue
            | Function::EncapsulatedInterface => false,
        }
    }

    /// Whether a request to all units of a serial line may have the function: it writes, and returns no values
    /// (Modbus over Serial Line V1.02, 2.1).
    pub fn can_be_broadcast(self) -> bool {
        self.is_write() && self != Function::ReadWriteMultipleRegisters
    }
}

codes! {
    /// Why a server refused a request.
    ///
    /// ```
    /// use holdfast_protocol::pdu::ExceptionCode;
    ///
    /// let code = ExceptionCode::from_code(2).unwrap();
    /// assert_eq!(code.to_string(), "exception 0x02 (Illegal Data Address)");
    /// ```
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Error)]
    #[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
    #[error("exception {:#04x} ({})", self.code(), self.name())]
    ExceptionCode: u8 {
        IllegalFunction = 1, "Illegal Function";
        IllegalDataAddress = 2, "Illegal Data Address";
        IllegalDataValue = 3, "Illegal Data Value";
        ServerDeviceFailure = 4, "Server Device Failure";
        Acknowledge = 5, "Acknowledge";
        ServerDeviceBusy = 6, "Server Device Busy";
        MemoryParityError = 8, "Memory Parity Error";
        GatewayPathUnavailable = 10, "Gateway Path Unavailable";
        GatewayTargetFailedToRespond = 11, "Gateway Target Device Failed To Respond";
    }
}
