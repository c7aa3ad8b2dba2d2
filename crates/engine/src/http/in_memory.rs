//! A connection without a network: the bytes that arrive, in pieces, and what is answered.

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

    fn socket(&self) -> &TcpStream {
        &self.socket
    }
}

/// What a client sees, the bodies that the handler got, and how many requests were broken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    pub received: String,
    pub bodies: Vec<Bytes>,
    pub broken: u64,
    /// How many requests the handler has answered.
    pub answered: usize,
}

pub(super) fn front() -> (Arc<Front>, Arc<Inbox<Event>>) {
    let (inbox, _wakes) = Inbox::new().unwrap();
    let inbox = Arc::new(inbox);
    let refusal = RefusalBody { body: Bytes::from_static(b"refused"), ..RefusalBody::default() };
    let settings = HttpSettings {
        name: "test".into(),
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
        refusals: [(); Refusal::ALL.len()].map(|()| refusal.clone()),
    };
    let (reporter, _) = event::channel(Verbosity::Nothing);
    (Arc::new(Front::new(settings, None, Arc::clone(&inbox), reporter)), inbox)
}

/// What the handler got and did.
#[derive(Default)]
struct Handled {
    bodies: Vec<Bytes>,
    answered: usize,
}

/// Answers requests: those to `/early` without their body, the others with its length.
async fn handle(inbox: &Inbox<Event>, handled: &Mutex<Handled>) {
    let mut waiting: Vec<Arc<Exchange>> = Vec::new();
    let mut known = HashSet::new();
    let respond = |exchange: &Arc<Exchange>, status: u16, closes: bool| {
        let head = ResponseHead::new(status, std::iter::empty()).unwrap();
        handled.lock().unwrap().answered += 1;
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
                            handled.lock().unwrap().bodies.push(body);
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
                Event::Gone { number } => {
                    let gone = waiting.iter().find(|exchange| exchange.number == number);
                    gone.inspect(|exchange| exchange.abandon());
                    continue;
                }
                Event::Late { .. } | Event::Room { .. } => continue,
            };
            handled.lock().unwrap().bodies.extend(body);
            let exchange = waiting.iter().find(|exchange| exchange.number == number).unwrap();
            respond(exchange, status, status != 200);
        }
        inbox.flush();
        yield_now().await;
    }
}

/// A connection on which these bytes arrive, and what is written to it.
pub(super) async fn line(
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
    let due = Instant::now() + front.settings.request_timeout;
    let (ticket, _) = front.context.admission.admit(peer).unwrap();
    let line =
        SharedLine::new(Arc::clone(front), (ticket, Peer::from(peer)), Box::new(stream), due);
    (line, written)
}

pub fn outcome(runtime: &Runtime, sent: &[&[u8]], is_pausing: bool) -> Outcome {
    let (front, inbox) = front();
    let handled = Mutex::new(Handled::default());
    let written = runtime.block_on(async {
        let (line, written) = line(&front, sent, is_pausing).await;
        let (_stop, stopping) = watch::channel(false);
        tokio::select! {
            _ = converse(&front, &line, stopping) => {}
            () = handle(&inbox, &handled) => {}
            () = inbox.deliver() => {}
        }
        written
    });
    let written = String::from_utf8(std::mem::take(&mut *written.lock().unwrap())).unwrap();
    let lines = written.split_inclusive("\r\n").filter(|line| !line.starts_with("date: "));
    let broken = front.context.connections.broken_request.get();
    let Handled { bodies, answered } = handled.into_inner().unwrap();
    Outcome { received: lines.collect(), bodies, broken, answered }
}

pub fn runtime() -> Runtime {
    Builder::new_current_thread().enable_all().build().unwrap()
}
