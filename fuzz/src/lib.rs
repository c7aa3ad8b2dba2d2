//! What must hold for all bytes that a codec may be given: one module a target of `fuzz_targets`, each with
//! a function `check` that panics if it does not hold. A check reads all that it varies from its bytes.

#![forbid(unsafe_code)]

pub mod ascii;
pub mod client;
pub mod file;
pub mod hello;
pub mod http;
#[path = "../../crates/journal/tests/support/mod.rs"]
mod journal_support;
pub mod log;
pub mod mbap;
pub mod plan;
pub mod raw_ingest;
pub mod request;
pub mod response;
pub mod rtu;
pub mod server;
pub mod step;
#[path = "../../crates/engine/src/tls/hello.rs"]
mod tls_hello;

/// A check.
pub type Check = fn(&[u8]);

/// All checks, with the names of their targets.
pub const TARGETS: [(&str, Check); 14] = [
    ("ascii", ascii::check),
    ("client", client::check),
    ("file", file::check),
    ("hello", hello::check),
    ("http", http::check),
    ("log", log::check),
    ("mbap", mbap::check),
    ("plan", plan::check),
    ("raw_ingest", raw_ingest::check),
    ("request", request::check),
    ("response", response::check),
    ("rtu", rtu::check),
    ("server", server::check),
    ("step", step::check),
];

/// Splits bytes behind a part whose length is their first byte. The part may end with them.
fn counted(data: &[u8]) -> (&[u8], &[u8]) {
    let Some((len, rest)) = data.split_first() else { return (&[], &[]) };
    rest.split_at(rest.len().min(usize::from(*len)))
}

/// Cuts a stream into pieces: each byte of `lengths` is the length of one, again and again.
fn pieces<'s>(lengths: &[u8], mut stream: &'s [u8]) -> Vec<&'s [u8]> {
    let mut pieces = Vec::new();
    for len in lengths.iter().cycle().map(|len| usize::from(*len).max(1)) {
        let (piece, rest) = stream.split_at(stream.len().min(len));
        pieces.push(piece);
        stream = rest;
        if stream.is_empty() {
            return pieces;
        }
    }
    vec![stream]
}
