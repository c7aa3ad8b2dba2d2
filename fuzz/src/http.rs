//! A connection of an HTTP client: [lengths of the pieces] what it sends.

use std::sync::OnceLock;

use holdfast_engine::http::in_memory::{Outcome, outcome, runtime};

/// However requests are cut, they have the same outcome; each has one response, and what is no request has one
/// refusal, which is the last response.
pub fn check(data: &[u8]) {
    let (lengths, stream) = crate::counted(data);
    // How much of a header is judged before its end depends on the cuts: it has an end here.
    let stream = [stream, b"\r\n\r\n"].concat();
    let whole = seen(&[&stream], false);
    assert_eq!(seen(&crate::pieces(lengths, &stream), true), whole, "cut into {lengths:?}");
    let responses = whole.received.matches("HTTP/1.1 ").count();
    let awaited = whole.received.matches("HTTP/1.1 100 ").count();
    let refusals = usize::try_from(whole.broken).expect("few refusals");
    assert!(refusals <= 1, "{whole:?}");
    assert!(responses - awaited <= whole.answered + refusals, "{whole:?}");
}

fn seen(pieces: &[&[u8]], is_pausing: bool) -> Outcome {
    thread_local! {
        static RUNTIME: OnceLock<tokio::runtime::Runtime> = const { OnceLock::new() };
    }
    RUNTIME.with(|cell| outcome(cell.get_or_init(runtime), pieces, is_pausing))
}
