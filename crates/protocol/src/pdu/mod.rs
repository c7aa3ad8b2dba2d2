//! Protocol data units: a function code and its data, the same on every transport (V1.1b3, 4).

/// An enum of codes of the standard, each with its name there.
macro_rules! codes {
    ($(#[$meta:meta])* $name:ident: $int:ident { $($variant:ident = $code:literal, $text:literal;)* }) => {
        $(#[$meta])*
        #[repr($int)]
        pub enum $name { $($variant = $code,)* }

        impl $name {
            pub const fn from_code(code: $int) -> Option<$name> {
                match code {
                    $($code => Some($name::$variant),)*
                    _ => None,
                }
            }

            pub const fn code(self) -> $int {
                self as $int
            }

            /// The standard's name.
            pub const fn name(self) -> &'static str {
                match self { $($name::$variant => $text,)* }
            }
        }
    };
}

mod diagnostics;
mod function;
pub mod identification;
pub mod reply;
mod request;
mod response;

pub use diagnostics::{Diagnostics, SubFunction};
pub use function::{ExceptionCode, Function};
pub use request::{Range, Request};
pub use response::{Response, ResponseError};

/// The longest PDU, in bytes (V1.1b3, 4.1).
pub const MAX_LEN: usize = 253;

/// Room for one PDU of any kind.
pub type Buffer = [u8; MAX_LEN];

/// The most items of one request (V1.1b3, 6).
pub mod limit {
    pub const READ_BITS: u16 = 2000;
    pub const READ_REGISTERS: u16 = 125;
    pub const WRITE_BITS: u16 = 1968;
    pub const WRITE_REGISTERS: u16 = 123;
    /// Written by function 23, which carries a read beside the write.
    pub const READ_WRITE_REGISTERS: u16 = 121;
}
