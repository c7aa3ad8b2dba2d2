#![doc = include_str!("../README.md")]
//!
//! # Modules
//!
//! * [`pdu`]: requests, responses and exceptions. A server calls [`pdu::Request::parse`] and
//!   [`pdu::reply`], a client [`pdu::Request::encode`] and [`pdu::Request::response`].
//! * [`frame`]: what each transport puts around a PDU. [`frame::mbap`] for TCP and UDP,
//!   [`frame::rtu`] for serial lines and RTU over TCP, [`frame::ascii`] for serial lines.
//! * [`raw_ingest`]: Raw Ingest packets.
//! * `client`: the client side of a connection: requests in flight, timeouts and late replies,
//!   without I/O (feature `alloc`).
//!
//! # Rules that this crate keeps
//!
//! * One codec for both sides.
//! * Requests and responses borrow from the frame. Replies are written in place, into the buffer
//!   that is sent.
//! * Values of public types have passed the checks of the standard, so encoding a request cannot
//!   fail.
//! * Bytes from outside cannot cause a panic: every length is checked, every conversion is total.
//! * The crate does not check what depends on a memory (addresses) or on a policy (units, rights).

#![no_std]
#![forbid(unsafe_code)]
#![warn(missing_docs)]

#[cfg(feature = "alloc")]
extern crate alloc;

#[cfg(target_pointer_width = "16")]
compile_error!("lengths of frames and packets require pointers of 32 bits or more");

/// An enum of codes, each with its name.
macro_rules! codes {
    (
        $(#[$meta:meta])*
        $name:ident: $int:ident { $($(#[$about:meta])* $variant:ident = $code:literal, $text:literal;)* }
    ) => {
        $(#[$meta])*
        #[repr($int)]
        pub enum $name {
            $(
                #[doc = concat!($text, " (code ", stringify!($code), ").")]
                ///
                $(#[$about])*
                $variant = $code,
            )*
        }

        impl $name {
            /// All variants, in the order of their codes.
            pub const ALL: &'static [$name] = &[$($name::$variant),*];

            /// The variant with this code, if there is one.
            pub const fn from_code(code: $int) -> Option<$name> {
                match code {
                    $($code => Some($name::$variant),)*
                    _ => None,
                }
            }

            /// The code of this variant.
            pub const fn code(self) -> $int {
                self as $int
            }

            /// The name of this variant.
            pub const fn name(self) -> &'static str {
                match self { $($name::$variant => $text,)* }
            }
        }
    };
}

#[cfg(feature = "alloc")]
pub mod client;
pub mod frame;
pub mod pdu;
pub mod raw_ingest;
