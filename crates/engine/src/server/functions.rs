//! Which functions a rule allows, and which requests are known to only read.

use holdfast_protocol::pdu::{Function, Request};

/// Functions of the standard that only read, and that memories do not know (V1.1b3, 6): exception
/// status, event log, file records, FIFO queue.
pub const OTHER_READS: [u8; 4] = [7, 12, 20, 24];

/// The function of the standard that writes file records (V1.1b3, 6.15).
pub const WRITE_FILE_RECORD: u8 = 21;

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
pub(super) struct Codes([u64; 4]);

impl Codes {
    #[inline]
    pub(super) fn has(&self, code: u8) -> bool {
        self.0[usize::from(code >> 6)] >> (code & 63) & 1 == 1
    }

    pub(super) fn of(functions: &Functions, access: AccessMode, of_device: bool) -> Codes {
        let mut codes = Codes::default();
        for code in (0..=u8::MAX).filter(|code| is_allowed(*code, functions, access, of_device)) {
            codes.0[usize::from(code >> 6)] |= 1 << (code & 63);
        }
        codes
    }

    pub(super) fn with(self, other: Codes) -> Codes {
        Codes(std::array::from_fn(|index| self.0[index] | other.0[index]))
    }
}

fn is_allowed(code: u8, functions: &Functions, access: AccessMode, of_device: bool) -> bool {
    let (named, listed) = match functions {
        Functions::All => (true, false),
        Functions::Only(codes) => (codes.contains(&code), true),
        Functions::Except(codes) => (!codes.contains(&code), false),
    };
    let writes = access == AccessMode::ReadWrite;
    named
        && match Function::from_code(code) {
            Some(function) => writes || !function.is_write(),
            // Only devices know other functions.
            None if !of_device || code & 0x80 != 0 => false,
            None if OTHER_READS.contains(&code) => true,
            None => writes && (listed || code == WRITE_FILE_RECORD),
        }
}

/// Whether a request writes, also to a file of a device.
#[inline]
pub(super) fn is_write(request: &[u8]) -> bool {
    let code = request.first().copied().unwrap_or_default();
    code == WRITE_FILE_RECORD || Function::from_code(code).is_some_and(Function::is_write)
}

/// Whether a request is known to change nothing in a device.
pub(super) fn only_reads(request: &[u8]) -> bool {
    let code = request.first().copied().unwrap_or_default();
    match Function::from_code(code) {
        Some(Function::Diagnostics | Function::EncapsulatedInterface) => {
            Request::parse(request).is_ok_and(|request| request.is_read())
        }
        Some(function) => !function.is_write(),
        None => OTHER_READS.contains(&code),
    }
}
