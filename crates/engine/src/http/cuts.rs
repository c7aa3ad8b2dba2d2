//! Requests cut and joined in every way: the responses and what was counted are the same.

use std::collections::{HashSet, VecDeque};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::{Builder, Runtime};
use tokio::sync::watch;
use tokio::task::yield_now;

use super::connection::converse;
use super::exchange::{Event, Exchange, ResponseHead};
use super::front::{Front, HttpSettings};
use super::inbox::Inbox;
use super::line::SharedLine;
use super::refusal::{Refusal, RefusalBody};
use crate::server::connections::admission::ConnectionLimits;
use crate::server::reports::event::{self, Kind, Verbosity};
use crate::server::transports::stream::{End, Stream};
use crate::server::{Peer, WhenFull};

/// How often everything else may run between two pieces.
const TURNS: usize = 12;

/// The most bytes of a body.
const MAX_BODY_BYTES: usize = 1024;

/// A connection whose bytes a test has.
struct Pieces {
    pieces: VecDeque<Vec<u8>>,
    /// Whether everything else may run between two pieces.
    is_pausing: bool,
    turns: usize,
    written: Arc<Mutex<Vec<u8>>>,
    socket: TcpStream,
}

impl Stream for Pieces {
    fn poll_read(
        &mut self,
        context: &mut Context<'_>,
        input: &mut [u8],
        _unsent: &mut Vec<u8>,
    ) -> Poll<Result<usize, End>> {
        if self.is_pausing && self.turns < TURNS {
            self.turns += 1;
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        self.turns = 0;
        Poll::Ready(match self.pieces.pop_front() {
            Some(piece) => {
                input[..piece.len()].copy_from_slice(&piece);
                Ok(piece.len())
            }
            None => Err(End::ByPeer),
        })
    }

    fn read_now(&mut self, _input: &mut [u8], _unsent: &mut Vec<u8>) -> Option<usize> {
        None
    }

    fn send(&mut self, output: &[u8], _unsent: &mut Vec<u8>) -> Result<(), Kind> {
        self.written.lock().unwrap().extend_from_slice(output);
        Ok(())
    }

    fn is_amid_record(&self) -> bool {
        false
    }

    fn end(&mut self, _unsent: &mut Vec<u8>) {}

    fn socket(&self) -> &TcpStream {
        &self.socket
    }
}

/// What a client sees, the bodies that the handler got, and how many requests were broken.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Outcome {
    received: String,
    bodies: Vec<Bytes>,
    broken: u64,
}

fn front() -> (Arc<Front>, Arc<Inbox<Event>>) {
    let (inbox, _wakes) = Inbox::new().unwrap();
    let inbox = Arc::new(inbox);
    let refusal = RefusalBody { body: Bytes::from_static(b"refused"), ..RefusalBody::default() };
    let settings = HttpSettings {
        name: "test".into(),
        socket: std::net::TcpListener::bind(("127.0.0.1", 0)).unwrap(),
        sources: vec!["127.0.0.0/8".parse().unwrap()],
        limits: ConnectionLimits {
            max_connections: 9,
            max_connections_per_source: None,
            when_full: WhenFull::Refuse,
            max_handshakes: None,
            grace: Duration::ZERO,
        },
        request_timeout: Duration::from_secs(60),
        idle_timeout: Duration::from_secs(60),
        leaving: false,
        tls: None,
        refusals: [(); Refusal::ALL.len()].map(|()| refusal.clone()),
    };
    let (reporter, _) = event::channel(Verbosity::Nothing);
    (Arc::new(Front::new(settings, Arc::clone(&inbox), reporter).0), inbox)
}

/// Answers requests: those to `/early` without their body, the others with its length.
async fn handle(inbox: &Inbox<Event>, bodies: &Mutex<Vec<Bytes>>) {
    let mut waiting: Vec<Arc<Exchange>> = Vec::new();
    let mut known = HashSet::new();
    let respond = |exchange: &Arc<Exchange>, status: u16, closes: bool| {
        let head = ResponseHead::new(status, std::iter::empty()).unwrap();
        exchange.respond(head, Bytes::from_static(b"said"), closes);
    };
    loop {
        for event in inbox.take() {
            let (number, status, body) = match event {
                Event::Request { exchange, head, body } => {
                    assert!(known.insert(exchange.number));
                    let is_early = head.parts.uri.path() == "/early";
                    match body {
                        _ if is_early => respond(&exchange, 415, false),
                        Some(body) if body.len() > MAX_BODY_BYTES => respond(&exchange, 413, true),
                        Some(body) => {
                            bodies.lock().unwrap().push(body);
                            respond(&exchange, 200, false);
                        }
                        None => {
                            exchange.receive(MAX_BODY_BYTES);
                            waiting.push(exchange);
                        }
                    }
                    continue;
                }
                Event::Body { number, body } => (number, 200, Some(body)),
                Event::TooLarge { number } => (number, 413, None),
                Event::Broken { number } => (number, 400, None),
                Event::Late { .. } | Event::Gone { .. } | Event::Room { .. } => continue,
            };
            bodies.lock().unwrap().extend(body);
            let exchange = waiting.iter().find(|exchange| exchange.number == number).unwrap();
            respond(exchange, status, status != 200);
        }
        inbox.flush();
        yield_now().await;
    }
}

/// A connection on which these bytes arrive, and what is written to it.
async fn line(
    front: &Arc<Front>,
    sent: &[&[u8]],
    is_pausing: bool,
) -> (SharedLine, Arc<Mutex<Vec<u8>>>) {
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
    let socket = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
    let pieces = sent.iter().flat_map(|piece| piece.chunks(9000)).map(<[u8]>::to_vec).collect();
    let written = Arc::new(Mutex::new(Vec::new()));
    let stream = Pieces { pieces, is_pausing, turns: 0, written: Arc::clone(&written), socket };
    let peer = SocketAddr::from(([127, 0, 0, 1], 50_000));
    let due = Instant::now() + front.request_timeout;
    let (ticket, _) = front.context.admission.admit(peer).unwrap();
    let line =
        SharedLine::new(Arc::clone(front), (ticket, Peer::from(peer)), Box::new(stream), due);
    (line, written)
}

fn outcome(runtime: &Runtime, sent: &[&[u8]], is_pausing: bool) -> Outcome {
    let (front, inbox) = front();
    let bodies = Mutex::new(Vec::new());
    let written = runtime.block_on(async {
        let (line, written) = line(&front, sent, is_pausing).await;
        let (_stop, stopping) = watch::channel(false);
        tokio::select! {
            _ = converse(&front, &line, stopping) => {}
            () = handle(&inbox, &bodies) => {}
            () = inbox.deliver() => {}
        }
        written
    });
    let written = String::from_utf8(std::mem::take(&mut *written.lock().unwrap())).unwrap();
    let lines = written.split_inclusive("\r\n").filter(|line| !line.starts_with("date: "));
    let broken = front.context.connections.broken_request.get();
    Outcome { received: lines.collect(), bodies: bodies.into_inner().unwrap(), broken }
}

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
        ("GET http:// HTTP/1.1\r\n\r\n".into(), "400"),
        ("GET / HTTP/2.0\r\n\r\n".into(), "400"),
        (format!("{get}X: {}\r\n\r\n", "x".repeat(70_000)), "431"),
    ]
}

fn runtime() -> Runtime {
    Builder::new_current_thread().enable_all().build().unwrap()
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
