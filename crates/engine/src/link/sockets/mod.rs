//! The connection or serial line of a link.

pub(crate) mod blocking_link;
pub(crate) mod connect;
pub(crate) mod handshake;
pub(crate) mod tcp;
