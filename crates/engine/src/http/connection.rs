//! One connection: its requests one after the other, and its end.

use std::error::Error as _;
use std::future::poll_fn;
use std::io;
use std::net::SocketAddr;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::Poll;
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use hyper::body::{Body, Incoming};
use hyper::header::EXPECT;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Request, Response, StatusCode, Version};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::{sleep_until, timeout_at};

use super::exchange::{Abandoned, Event, Exchange, Order, RequestHead, ResponseHead};
use super::front::{Front, fails};
use super::line::{ConnectionEnd, NEVER, SharedLine, Wire};
use super::refusal::{Refusal, RefusalBody};
use super::request_bytes::MAX_HEADER_BYTES;
use super::response_body::ResponseBody;
use crate::server::Peer;
use crate::server::connections::admission::Ticket;
use crate::server::connections::closing::drain_for;
use crate::server::connections::listener::{Admitted, KEEPALIVE, set_tcp_options};
use crate::server::reports::event::Kind;
use crate::server::transports::secure::secured;
use crate::server::transports::stream::Stream;

/// How long a peer is read after its last response.
const LINGER: Duration = Duration::from_secs(2);

/// A body that nobody wants is read and dropped in chunks of about this size.
const SKIPPED_CHUNK_BYTES: usize = 65_536;

/// The type of a TLS record that begins a handshake (RFC 8446, 5.1).
const HANDSHAKE: u8 = 22;

/// Serves a connection to its end.
pub(super) async fn serve(
    front: Arc<Front>,
    connection: Admitted<()>,
    stop: watch::Receiver<bool>,
) {
    let Admitted { stream, peer, ticket, .. } = connection;
    set_tcp_options(&stream, KEEPALIVE);
    // One time for the handshake and the first request.
    let due = Instant::now() + front.settings.request_timeout;
    let begun = begin(&front, (stream, peer), &ticket, due, stop.clone()).await;
    let Some((stream, peer)) = begun else { return };
    let line = SharedLine::new(Arc::clone(&front), (ticket, peer), stream, due);
    let end = converse(&front, &line, stop.clone()).await;
    let Some(mut line) = line.into_line() else { return };
    match end {
        ConnectionEnd::Dropped => return,
        ConnectionEnd::Idle => return line.announce_end(),
        ConnectionEnd::Answered => {}
    }
    if line.has_unread() {
        line.ticket.set_answered();
        let mut stream = line.into_stream();
        drain_for(LINGER, &mut *stream, stop, |_| ()).await;
    }
}

/// Begins TLS if the front has it. `None`: the connection has ended.
async fn begin(
    front: &Front,
    (stream, peer): (TcpStream, SocketAddr),
    ticket: &Ticket,
    due: Instant,
    mut stop: watch::Receiver<bool>,
) -> Option<(Box<dyn Stream>, Peer)> {
    let Some(tls) = front.tls() else {
        return Some((Box::new(stream), peer.into()));
    };
    let mut first = [0];
    let peeked = tokio::select! {
        biased;
        _ = stop.wait_for(|stop| *stop) => return None,
        peeked = timeout_at(due.into(), stream.peek(&mut first)) => peeked,
    };
    match peeked {
        Err(_) => front.ended(Kind::TlsFailed("timeout"), peer.into()),
        Ok(Ok(1)) if first == [HANDSHAKE] => {
            let context = &front.context;
            let limit = due.saturating_duration_since(Instant::now());
            let (stream, peer) =
                secured(&tls, context, (stream, peer), ticket, limit, stop).await?;
            let now = front.tls()?;
            if context.end_after_reload((&*tls, &*now), (ticket, &peer), fails) {
                front.inbox.wake();
                return None;
            }
            return Some((Box::new(stream), peer));
        }
        Ok(Ok(1)) => {
            front.ended(Kind::TlsFailed("not_tls"), peer.into());
            refuse_plain(front, stream, first[0], stop).await;
        }
        Ok(_) => {}
    }
    None
}

/// Answers an HTTP request without TLS; closes anything else.
async fn refuse_plain(
    front: &Front,
    mut stream: TcpStream,
    first: u8,
    stop: watch::Receiver<bool>,
) {
    if !first.is_ascii_alphabetic() {
        return;
    }
    let refusal = front.refusal(Refusal::NotTls);
    let head = b"HTTP/1.1 400 Bad Request\r\nconnection: close\r\n";
    let response = [&head[..], &refusal.lines(), b"\r\n", &refusal.body].concat();
    if stream.try_write(&response).is_ok() {
        drain_for(LINGER, &mut stream, stop, |_| ()).await;
    }
}

/// Serves the requests of a connection.
pub(super) async fn converse(
    front: &Arc<Front>,
    shared: &SharedLine,
    mut stop: watch::Receiver<bool>,
) -> ConnectionEnd {
    let mut stopped = pin!(stop.wait_for(|stop| *stop));
    let mut alarm = pin!(sleep_until((Instant::now() + NEVER).into()));
    let begun = || {
        let service = service_fn(|request| answered(Arc::clone(front), shared.clone(), request));
        http1::Builder::new()
            .half_close(true)
            .max_header_size(MAX_HEADER_BYTES)
            .max_buf_size(MAX_HEADER_BYTES + 8192)
            .header_read_timeout(None)
            .serve_connection(Wire(shared.clone()), service)
    };
    let mut is_stopping = false;
    // hyper takes memory for each connection, so it has only those with a request.
    let mut serving = None;
    poll_fn(|context| {
        loop {
            let stops_now = !is_stopping && stopped.as_mut().poll(context).is_ready();
            is_stopping |= stops_now;
            let Some(connection) = &mut serving else {
                if is_stopping {
                    return Poll::Ready(ConnectionEnd::Idle);
                }
                let mut line = shared.lock();
                match line.poll_fill(context) {
                    Poll::Ready(Ok(0)) if line.is_used => return Poll::Ready(ConnectionEnd::Idle),
                    Poll::Ready(Ok(0) | Err(_)) => return Poll::Ready(ConnectionEnd::Dropped),
                    Poll::Ready(Ok(_)) => serving = Some(Box::pin(begun())),
                    Poll::Pending => return line.poll_deadlines(context, alarm.as_mut()),
                }
                continue;
            };
            if stops_now {
                let line = shared.lock();
                // The peer may never send the rest.
                if !line.is_busy() || line.lacks_rest() {
                    return Poll::Ready(ConnectionEnd::Idle);
                }
                drop(line);
                connection.as_mut().graceful_shutdown();
            }
            if let Poll::Ready(ended) = connection.as_mut().poll(context) {
                let has_response = ended.is_ok() || shared.lock().refused.is_some();
                return Poll::Ready(if has_response {
                    ConnectionEnd::Answered
                } else {
                    ConnectionEnd::Dropped
                });
            }
            let mut line = shared.lock();
            if line.poll_ahead(context) || line.is_left() {
                return Poll::Ready(ConnectionEnd::Dropped);
            }
            if !line.is_idle() {
                return line.poll_deadlines(context, alarm.as_mut());
            }
            drop(line);
            serving = None;
        }
    })
    .await
}

/// Hands a request to its handler, and returns the response. hyper reads the body once this returns the
/// future, so what has arrived, and what is read next, is noted before.
fn answered(
    front: Arc<Front>,
    line: SharedLine,
    request: Request<Incoming>,
) -> impl Future<Output = Result<Response<ResponseBody>, Abandoned>> {
    let exchange = front.exchange(line.downgrade());
    let len = request.body().size_hint().exact();
    let version = request.version();
    let expects = request.headers().contains_key(EXPECT);
    let (is_ambiguous, has_body) = {
        let mut line = line.lock();
        let has_body = !expects && len.is_some_and(|len| line.has(len));
        (line.begin(Arc::clone(&exchange), len), has_body)
    };
    async move {
        let mut response = if is_ambiguous {
            front.ended(Kind::BrokenRequest, line.lock().peer.clone());
            refused(&front, exchange, line)
        } else {
            handled(front, line, exchange, request, has_body).await?
        };
        // After one of HTTP/1.1, hyper would promise to keep a connection that ends.
        *response.version_mut() = version;
        Ok(response)
    }
}

async fn handled(
    front: Arc<Front>,
    line: SharedLine,
    exchange: Arc<Exchange>,
    request: Request<Incoming>,
    has_body: bool,
) -> Result<Response<ResponseBody>, Abandoned> {
    let (parts, body) = request.into_parts();
    let len = body.size_hint().exact();
    let expects = parts.headers.contains_key(EXPECT);
    let is_old = parts.version == Version::HTTP_10;
    let peer = line.lock().peer.clone();
    let mut upload = Upload {
        line: line.clone(),
        body,
        received: BytesMut::new(),
        is_over: false,
        is_cut: false,
    };
    let mut handled = Handled { exchange: Arc::clone(&exchange), is_answered: false };
    let whole = match len {
        Some(0) => {
            upload.is_over = true;
            Some(Bytes::new())
        }
        // It has arrived with the header, unless the connection breaks.
        Some(_) if has_body => upload.receive(usize::MAX).await.ok(),
        _ => None,
    };
    let head = Box::new(RequestHead { parts, peer, len });
    exchange.notify(Event::Request { exchange: Arc::clone(&exchange), head, body: whole });
    let parts = (Arc::clone(&exchange), line.clone());
    let response = match upload.ordered(&front, &exchange).await {
        Answered::Whole { head, body, mut closes } => {
            closes |= is_old || !upload.skipped(&front, &exchange, closes || expects).await;
            ResponseBody::whole(parts, head, body, closes)
        }
        Answered::Stream(head) => ResponseBody::stream(parts, head),
        Answered::Nothing => return Err(Abandoned),
    };
    line.lock().note_answering();
    handled.is_answered = true;
    Ok(response)
}

/// Refuses a request that hyper accepts.
fn refused(front: &Front, exchange: Arc<Exchange>, line: SharedLine) -> Response<ResponseBody> {
    let RefusalBody { headers, body } = front.refusal(Refusal::NotHttp);
    let head = ResponseHead { status: StatusCode::BAD_REQUEST, headers: headers.clone() };
    line.lock().note_answering();
    ResponseBody::whole((exchange, line.clone()), head, body.clone(), true)
}

/// Tells the handler that the client is gone if the connection ends before there is a response.
struct Handled {
    exchange: Arc<Exchange>,
    is_answered: bool,
}

impl Drop for Handled {
    fn drop(&mut self) {
        if !self.is_answered {
            self.exchange.finish(false);
        }
    }
}

enum Answered {
    Whole { head: ResponseHead, body: Bytes, closes: bool },
    Stream(ResponseHead),
    Nothing,
}

/// The body of a request, as far as the handler wants it.
struct Upload {
    line: SharedLine,
    body: Incoming,
    received: BytesMut,
    is_over: bool,
    is_cut: bool,
}

/// Why a body can't be had.
enum NoBody {
    TooLarge,
    /// It is not HTTP.
    Broken,
    /// The connection has ended.
    Cut,
}

impl Upload {
    /// Receives until the end, at most `most` bytes.
    async fn receive(&mut self, most: usize) -> Result<Bytes, NoBody> {
        if self.is_cut {
            // hyper reports an error once, and then an end.
            return Err(NoBody::Cut);
        }
        while !self.is_over {
            match poll_fn(|context| Pin::new(&mut self.body).poll_frame(context)).await {
                Some(Ok(frame)) => {
                    if let Ok(data) = frame.into_data() {
                        self.received.extend_from_slice(&data);
                    }
                    if self.received.len() > most {
                        return Err(NoBody::TooLarge);
                    }
                }
                Some(Err(error)) => {
                    self.is_cut = true;
                    return Err(no_body(&error));
                }
                None => {
                    self.is_over = true;
                    self.line.lock().note_arrived();
                }
            }
        }
        Ok(std::mem::take(&mut self.received).freeze())
    }

    /// Carries out what the handler wants, until it has the response.
    async fn ordered(&mut self, front: &Front, exchange: &Exchange) -> Answered {
        let number = exchange.number;
        let mut wanted = None;
        loop {
            let order = match wanted {
                None => exchange.next().await,
                Some(most) => tokio::select! {
                    biased;
                    order = exchange.next() => order,
                    received = self.receive(most) => {
                        wanted = None;
                        exchange.notify(match received {
                            Ok(body) => Event::Body { number, body },
                            Err(NoBody::TooLarge) => Event::TooLarge { number },
                            Err(NoBody::Broken) => {
                                front.ended(Kind::BrokenRequest, self.line.lock().peer.clone());
                                Event::Broken { number }
                            }
                            Err(NoBody::Cut) => Event::Gone { number },
                        });
                        continue;
                    }
                },
            };
            match order {
                Order::Receive(most) => {
                    wanted = Some(most);
                    self.line.lock().note_asked();
                }
                Order::Late => {
                    wanted = None;
                    exchange.notify(Event::Late { number, received: self.received.len() });
                }
                Order::Respond { head, body, closes } => {
                    return Answered::Whole { head, body, closes };
                }
                Order::Begin(head) => return Answered::Stream(head),
                Order::Abandon => return Answered::Nothing,
            }
        }
    }

    /// Reads the rest of the request, so that the next one can follow. Returns whether it is read.
    async fn skipped(&mut self, front: &Front, exchange: &Exchange, closes: bool) -> bool {
        self.line.lock().note_asked();
        while !self.is_over && !closes {
            self.received.clear();
            tokio::select! {
                biased;
                order = exchange.next() => {
                    if matches!(order, Order::Late) {
                        return false;
                    }
                }
                received = self.receive(SKIPPED_CHUNK_BYTES) => match received {
                    Ok(_) | Err(NoBody::TooLarge) => {}
                    Err(NoBody::Broken) => {
                        front.ended(Kind::BrokenRequest, self.line.lock().peer.clone());
                        return false;
                    }
                    Err(NoBody::Cut) => return false,
                },
            }
        }
        self.is_over
    }
}

/// Why hyper has no more of a body. The kinds of errors are those of its decoder.
fn no_body(error: &hyper::Error) -> NoBody {
    let cause = error.source().and_then(|cause| cause.downcast_ref::<io::Error>());
    match cause.map(io::Error::kind) {
        Some(io::ErrorKind::InvalidInput | io::ErrorKind::InvalidData) => NoBody::Broken,
        _ => NoBody::Cut,
    }
}
