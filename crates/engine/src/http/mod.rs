//! HTTP/1.1 (RFC 9112): hyper parses requests and writes responses. This module limits what a peer may take,
//! and how long, and hands requests to an event loop in another thread. `crate::server::connections` admits
//! peers, and closes connections for others.
//!
//! * A request is handed over with its body if both have arrived together; otherwise the handler asks
//!   for the body, after it has judged the rest.
//! * hyper gets the bytes of one request at a time: what becomes of bytes does not depend on how the
//!   network has cut or joined them, and requests that were sent ahead wait as bytes.
//! * A connection has three deadlines: for its request to arrive, for its response to be taken, and
//!   for its next request to begin.

mod connection;
#[cfg(test)]
mod cut_tests;
mod exchange;
mod front;
#[cfg(any(test, feature = "fuzz"))]
pub mod in_memory;
mod inbox;
mod line;
mod refusal;
mod request_bytes;
mod response_body;
mod server;

pub use hyper::Version;
pub use hyper::header::CONTENT_LENGTH;
pub use hyper::http::request::Parts;

pub use exchange::{Event, Exchange, RequestHead, ResponseHead, Sent};
pub use front::HttpSettings;
pub use refusal::{Refusal, RefusalBody};
pub use server::{HttpServer, bind};
