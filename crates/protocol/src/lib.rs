//! Modbus as bytes in, bytes out: no socket, no clock, no allocation.
//!
//! The rules this crate keeps:
//!
//! * One codec for both sides. A [`pdu::Request`] is what a server parses and what a client
//!   encodes; a [`pdu::Response`] is what a client parses and what [`pdu::reply`] writes.
//! * Requests and responses borrow from the frame. Replies are written in place, into the buffer
//!   that is sent.
//! * Bytes from outside can't make it panic: every length is checked, every conversion is total.
//! * What depends on a memory (addresses) or on a policy (units, rights) is not judged here. A
//!   quantity that no memory could serve is.
//!
//! Specifications: Modbus Application Protocol V1.1b3 (`pdu`), Messaging on TCP/IP Implementation
//! Guide V1.0b (`frame::mbap`), Modbus over Serial Line V1.02 (`frame::rtu`, `frame::ascii`), Raw
//! Ingest v1 (`raw_ingest`).

#![forbid(unsafe_code)]

/// An enum of codes, each with its name.
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

            pub const fn name(self) -> &'static str {
                match self { $($name::$variant => $text,)* }
            }
        }
    };
}

pub mod frame;
pub mod pdu;
pub mod raw_ingest;
