//! Requests cut and joined in every way: the responses and what was counted are the same. And the end of a client.

use std::io::Write;
use std::net::{Shutdown, TcpStream};
use std::pin::pin;
use std::sync::Arc;
use std::time::Instant;

use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::yield_now;

use super::connection::converse;
use super::exchange::Event;
use super::in_memory::{front, line, outcome, runtime};
use super::line::SharedLine;
use crate::server::Peer;

fn post(path: &str, headers: &str, body: &str) -> String {
    let len = body.len();
    format!("POST {path} HTTP/1.1\r\nHost: x\r\n{headers}Content-Length: {len}\r\n\r\n{body}")
}

fn chunked(path: &str, body: &str) -> String {
    format!("POST {path} HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n{body}")
}

/// Requests, and the status of the response to each.
fn cases() -> Vec<(String, &'static str)> {
    let get = "GET / HTTP/1.1\r\nHost: x\r\n";
    vec![
        (format!("{get}\r\n"), "200"),
        (format!("\r\n\r\n{get}\r\n"), "200"),
        (post("/", "", "four"), "200"),
        (post("/", "Connection: close\r\n", "four"), "200"),
        (post("/", "Connection: Upgrade\r\nUpgrade: websocket\r\n", "four"), "200"),
        (post("/", "Expect: 100-continue\r\n", "four"), "100"),
        (post("/", "", &"x".repeat(1025)), "413"),
        (post("/early", "", "four"), "415"),
        (post("/early", "Expect: 100-continue\r\n", "four"), "415"),
        (post("/", "", "four").replace("1.1", "1.0"), "200"),
        (chunked("/", "3\r\nabc\r\n1;x=y\r\nd\r\n0\r\nX: y\r\n\r\n"), "200"),
        (chunked("/", "401\r\n") + &"x".repeat(1025) + "\r\n0\r\n\r\n", "413"),
        (chunked("/", "3\r\nabcd\r\n0\r\n\r\n"), "400"),
        (chunked("/", "x\r\n"), "400"),
        (chunked("/early", "3\r\nabc\r\n0\r\n\r\n"), "415"),
        (chunked("/early", "x\r\n"), "415"),
        (post("/", "Transfer-Encoding: chunked\r\n", "0\r\n\r\n"), "400"),
        (chunked("/", "0\r\n\r\n").replace("\r\n\r\n0", "\r\nContent-Length: 5\r\n\r\n0"), "400"),
        (post("/", "Content-Length: 9\r\n", "four"), "400"),
        ("\0garbage\r\n\r\n".into(), "400"),
        (format!("{get}X : y\r\n\r\n"), "400"),
        ("GET / HTTX/1.1\r\nX: y\r\n\r\r\nx\r\n\r\n".into(), "400"),
        ("\r\nGET / HTTP/1.1\nHost: x\n\r\n".into(), "200"),
        ("GET / HTTP/1.1\r\nHost: x\r\n\n".into(), "200"),
        ("GET http:// HTTP/1.1\r\n\r\n".into(), "400"),
        ("GET / HTTP/2.0\r\n\r\n".into(), "400"),
        (format!("{get}X: {}\r\n\r\n", "x".repeat(70_000)), "431"),
    ]
}

#[test]
fn a_request_has_the_same_outcome_however_it_is_cut() {
    let runtime = runtime();
    for (request, status) in cases() {
        let request = request.as_bytes();
        let whole = outcome(&runtime, &[request], false);
        assert_eq!(whole.received.get(9..12), Some(status), "{whole:?}");
        let cuts = (1..request.len().min(400)).map(|cut| request.split_at(cut));
        for (first, second) in cuts {
            for is_pausing in [false, true] {
                let pieces = [first, second];
                assert_eq!(outcome(&runtime, &pieces, is_pausing), whole, "{first:?}");
            }
        }
        if request.len() < 400 {
            let bytes: Vec<&[u8]> = request.chunks(1).collect();
            assert_eq!(outcome(&runtime, &bytes, true), whole);
        }
    }
}

#[test]
fn a_header_whose_end_hyper_does_not_find_ends_the_connection() {
    // hyper reads so long a header in parts, and does not take a line of two CRs for its end.
    let header = format!("GET / HTTP/1.1\r\nX: {}\r\n\r\r\n", "x".repeat(20_000));
    let whole = outcome(&runtime(), &[header.as_bytes(), &[b'x'; 90_000]], false);
    assert_eq!((whole.received.as_str(), whole.broken), ("", 1));
}

#[test]
fn joined_requests_have_the_same_outcome_as_those_that_are_sent_apart() {
    let (runtime, cases) = (runtime(), cases());
    let last = cases[0].0.as_bytes();
    for (first, _) in &cases {
        for (second, _) in &cases {
            let pieces = [first.as_bytes(), second.as_bytes(), last];
            let apart = outcome(&runtime, &pieces, true);
            assert_eq!(outcome(&runtime, &[&pieces.concat()], false), apart, "{first} {second}");
            assert_eq!(outcome(&runtime, &pieces, false), apart, "{first} {second}");
        }
    }
}

#[test]
fn a_body_that_has_arrived_with_its_header_is_handed_over_with_it() {
    let (runtime, (front, inbox)) = (runtime(), front());
    let request = post("/", "", "four");
    let event = runtime.block_on(async {
        let (line, _) = line(&front, &[request.as_bytes()], false).await;
        let (_stop, stopping) = watch::channel(false);
        tokio::select! {
            _ = converse(&front, &line, stopping) => unreachable!("there is no response"),
            event = async { loop { match inbox.take().pop() { Some(event) => break event, None => yield_now().await } } } => event,
        }
    });
    assert!(matches!(event, Event::Request { body: Some(body), .. } if body == "four"));
}

#[test]
fn the_end_of_a_client_is_found_while_the_thread_of_its_connection_stands_still() {
    let (front, inbox) = front();
    runtime().block_on(async {
        let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
        let mut client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (stream, peer) = listener.accept().await.unwrap();
        let (ticket, _) = front.context.admission.admit(peer).unwrap();
        let due = Instant::now() + front.settings.request_timeout;
        let of = (ticket, Peer::from(peer));
        let line = SharedLine::new(Arc::clone(&front), of, Box::new(stream), due);
        let (_stop, stopping) = watch::channel(false);
        let mut serving = pin!(converse(&front, &line, stopping));
        client.write_all(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n").unwrap();
        let event = tokio::select! {
            _ = &mut serving => unreachable!("there is no response"),
            event = async { loop { match inbox.take().pop() { Some(event) => break event, None => yield_now().await } } } => event,
        };
        let Event::Request { exchange, .. } = event else { unreachable!("{event:?}") };
        // From here on, the connection is not served.
        assert!(exchange.watch_client());
        client.write_all(b"GET / HT").unwrap();
        assert!(exchange.watch_client(), "it has begun its next request");
        client.shutdown(Shutdown::Write).unwrap();
        assert!(!exchange.watch_client());
    });
}
