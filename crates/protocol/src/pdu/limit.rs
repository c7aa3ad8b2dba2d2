//! The most items per request (V1.1b3, 6).

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
