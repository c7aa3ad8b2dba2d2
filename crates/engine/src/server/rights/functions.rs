//! Which functions a rule allows, and which requests are known to only read.

use holdfast_protocol::pdu::{ExceptionCode, Function, Request, is_one_request};

/// What answers the requests to a unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::server) enum Answerer {
    Device,
    Memory {
        /// Whether function 7 has bits to read.
        exception_status: bool,
        /// Whether functions 20 and 21 have files.
        files: bool,
        /// Whether function 24 has queues.
        queues: bool,
    },
}

impl Answerer {
    pub(in crate::server) const PLAIN_MEMORY: Answerer =
        Answerer::Memory { exception_status: false, files: false, queues: false };

    #[deny(clippy::wildcard_enum_match_arm)]
    fn knows(self, code: u8) -> bool {
        let Answerer::Memory { exception_status, files, queues } = self else { return true };
        let Some(function) = Function::from_code(code) else { return false };
        match function {
            Function::ReadExceptionStatus => exception_status,
            Function::ReadFileRecord | Function::WriteFileRecord => files,
            Function::ReadFifoQueue => queues,
            Function::ReadCoils
            | Function::ReadDiscreteInputs
            | Function::ReadHoldingRegisters
            | Function::ReadInputRegisters
            | Function::WriteSingleCoil
            | Function::WriteSingleRegister
            | Function::Diagnostics
            | Function::GetCommEventCounter
            | Function::GetCommEventLog
            | Function::WriteMultipleCoils
            | Function::WriteMultipleRegisters
            | Function::ReportServerId
            | Function::MaskWriteRegister
            | Function::ReadWriteMultipleRegisters
            | Function::EncapsulatedInterface => true,
        }
    }
}

/// What a rule allows its peers to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AccessMode {
    ReadOnly,
    ReadWrite,
}

/// The function codes of a rule.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Functions {
    All,
    Only(Vec<u8>),
    Except(Vec<u8>),
}

/// Function codes.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::server) struct Codes([u64; 4]);

impl Codes {
    #[inline]
    pub(in crate::server) fn has(&self, code: u8) -> bool {
        self.0[usize::from(code >> 6)] >> (code & 63) & 1 == 1
    }

    pub(in crate::server) fn of(
        functions: &Functions,
        access: AccessMode,
        answerer: Answerer,
    ) -> Codes {
        let mut codes = Codes::default();
        for code in (0..=u8::MAX).filter(|code| is_allowed(*code, functions, access, answerer)) {
            codes.0[usize::from(code >> 6)] |= 1 << (code & 63);
        }
        codes
    }

    pub(in crate::server) fn with(self, other: Codes) -> Codes {
        Codes(std::array::from_fn(|index| self.0[index] | other.0[index]))
    }
}

fn is_allowed(code: u8, functions: &Functions, access: AccessMode, answerer: Answerer) -> bool {
    let (named, listed) = match functions {
        Functions::All => (true, false),
        Functions::Only(codes) => (codes.contains(&code), true),
        Functions::Except(codes) => (!codes.contains(&code), false),
    };
    let writes = access == AccessMode::ReadWrite;
    named
        && answerer.knows(code)
        && match Function::from_code(code) {
            Some(function) => writes || !function.is_write(),
            None => writes && listed && code & 0x80 == 0,
        }
}

/// Whether a request writes.
#[inline]
pub(in crate::server) fn is_write(request: &[u8]) -> bool {
    let code = request.first().copied().unwrap_or_default();
    Function::from_code(code).is_some_and(Function::is_write)
}

/// Whether a request is function 43 with another MEI type than 14. Its length is unknown.
pub(in crate::server) fn is_other_interface(request: &[u8]) -> bool {
    request.first() == Some(&Function::EncapsulatedInterface.code())
        && Request::parse(request) == Err(ExceptionCode::IllegalFunction)
}

/// Whether a request is known to change nothing in a device. Behind a line, or behind a gateway to one,
/// one that is too long is a read and whatever follows it.
pub(in crate::server) fn only_reads(request: &[u8]) -> bool {
    if !is_one_request(request) {
        return false;
    }
    let code = request.first().copied().unwrap_or_default();
    match Function::from_code(code) {
        Some(Function::Diagnostics | Function::EncapsulatedInterface) => {
            Request::parse(request).is_ok_and(|request| request.is_read())
        }
        Some(function) => !function.is_write(),
        None => false,
    }
}
