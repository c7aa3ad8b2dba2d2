//! Listeners, by transport: where a frame ends, and what carries it.

#[cfg(test)]
pub(crate) mod cut_tests;
pub(crate) mod framing;
mod line_echo;
pub(crate) mod raw_ingest;
pub(crate) mod raw_ingest_buffer;
mod rtu_line;
pub(crate) mod secure;
pub(crate) mod serial;
pub(crate) mod shared_port;
pub(crate) mod stream;
pub(crate) mod tcp;
pub(crate) mod tls;
pub(crate) mod udp;
