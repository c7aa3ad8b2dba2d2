//! The most items per request (V1.1b3, 6). `Range` and the types of data check them; `Request::parse` says which
//! exception more of them have. For a FIFO queue, which has its length in memory, the server does.

/// Coils or discrete inputs that functions 1 and 2 read.
pub const READ_BITS: u16 = 2000;
/// Registers that functions 3, 4 and 23 read.
pub const READ_REGISTERS: u16 = 125;
/// Coils that function 15 writes.
pub const WRITE_BITS: u16 = 1968;
/// Registers that function 16 writes.
pub const WRITE_REGISTERS: u16 = 123;
/// Registers that function 23 writes. Its request also carries a read.
pub const READ_WRITE_REGISTERS: u16 = 121;
/// The last record of a file.
pub const LAST_RECORD: u16 = 9999;
/// Bytes behind the byte count of function 20, in a request and in its reply.
pub const READ_FILE_BYTES: usize = 0xF5;
/// Records that function 20 reads if it reads one range.
pub const READ_RECORDS: u16 = 121;
/// Bytes behind the byte count of function 21.
pub const WRITE_FILE_BYTES: usize = 0xFB;
/// Records that function 21 writes if it writes one range.
pub const WRITE_RECORDS: u16 = 122;
/// Registers of a FIFO queue (function 24).
pub const QUEUE_REGISTERS: u16 = 31;
/// Events of the log that function 12 reads.
pub const LOG_EVENTS: u16 = 64;
