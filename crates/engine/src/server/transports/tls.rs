//! TLS over the socket of a connection: converts between records and plain text.
//!
//! The memory that a peer can occupy is limited: one incomplete record, the plain text of one
//! complete record (16 KB), and the replies to it. Handshake messages are at most 64 KB long.
//! Renegotiation is refused, and a flood of alerts or key updates ends the connection.

use std::cell::RefCell;
use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

#[cfg(target_os = "linux")]
use socket2::SockRef;
use tokio::io::{AsyncRead, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::watch;

use crate::server::connections::closing::drain;
use crate::server::reports::event::Kind;
use crate::server::transports::stream::{self, End, Stream};
use crate::tls::TlsFailure;
use crate::tls::server::{PeerCertificate, ServerChannel, ServerTls};

/// Bytes per read of a socket.
const INPUT_BYTES: usize = 4096;

/// The header of a record, in bytes.
const HEADER_LEN: usize = 5;

/// Buffers of a worker thread, shared by all of its connections.
struct Scratch {
    input: Box<[u8]>,
    plain: Vec<u8>,
    output: Vec<u8>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::new(Scratch {
        input: vec![0; INPUT_BYTES].into_boxed_slice(),
        plain: Vec::new(),
        output: Vec::new(),
    });
}

pub(crate) struct ServerTlsStream {
    socket: TcpStream,
    pub(crate) channel: ServerChannel,
    records: Records,
    /// Plain text that did not fit into the input of the connection, and how much of it was read.
    plain: Vec<u8>,
    taken: usize,
    /// Why the stream has ended.
    ended: Option<End>,
}

impl ServerTlsStream {
    pub(crate) fn new(socket: TcpStream, tls: &ServerTls) -> Result<ServerTlsStream, Kind> {
        let channel =
            tls.channel().map_err(|error| Kind::from(failed(&TlsFailure::from(error))))?;
        let records = Records::default();
        Ok(ServerTlsStream { socket, channel, records, plain: Vec::new(), taken: 0, ended: None })
    }

    /// Performs the handshake.
    ///
    /// # Errors
    /// The peer is not trusted, or closed the connection. An alert has been sent.
    pub(crate) async fn handshake(&mut self, time_limit: Duration) -> Result<(), Kind> {
        let mut unsent = Vec::new();
        while self.channel.is_handshaking() || !unsent.is_empty() {
            stream::send_all(&self.socket, &unsent, time_limit).await?;
            unsent.clear();
            if self.channel.is_handshaking() {
                poll_fn(|context| self.poll_read(context, &mut [], &mut unsent)).await?;
            }
        }
        acknowledge(&self.socket);
        Ok(())
    }

    /// The certificate of the peer, after the handshake; `None` if clients need none.
    pub(crate) fn peer_certificate(&self) -> Result<Option<PeerCertificate>, Kind> {
        self.channel.peer_certificate().map_err(|failure| failed(&failure).into())
    }

    /// Announces the end without waiting.
    pub(crate) fn announce_end(&mut self) {
        let mut unsent = Vec::new();
        self.channel.end(&mut unsent);
        let _ = stream::flush_now(&self.socket, &mut unsent);
    }

    /// Announces the end, and closes the connection.
    pub(crate) async fn refuse(mut self, stop: watch::Receiver<bool>) {
        self.announce_end();
        drain(&mut self.socket, stop, |_| ()).await;
    }

    pub(crate) fn into_socket(self) -> TcpStream {
        self.socket
    }

    /// Processes received bytes. Returns the length of the plain text written to `input`.
    fn receive(
        &mut self,
        bytes: &[u8],
        (plain, output): (&mut Vec<u8>, &mut Vec<u8>),
        input: &mut [u8],
        unsent: &mut Vec<u8>,
    ) -> Result<usize, End> {
        plain.clear();
        output.clear();
        self.records.pass(bytes);
        if let Err(error) = self.channel.receive(bytes, plain, output) {
            self.ended = Some(failed(&error));
        } else if self.channel.has_ended() {
            self.ended = Some(End::ByPeer);
        }
        if !output.is_empty() {
            stream::send(&self.socket, output, unsent).map_err(|_| End::Broken)?;
        }
        let len = plain.len().min(input.len());
        input[..len].copy_from_slice(&plain[..len]);
        self.plain.extend_from_slice(&plain[len..]);
        Ok(len)
    }

    /// Takes waiting plain text, or returns the reason why there is no more; `None` when bytes must
    /// be read.
    fn take(&mut self, input: &mut [u8]) -> Option<Result<usize, End>> {
        let waiting = &self.plain[self.taken..];
        if waiting.is_empty() {
            return self.ended.map(Err);
        }
        let len = waiting.len().min(input.len());
        input[..len].copy_from_slice(&waiting[..len]);
        self.taken += len;
        if self.taken == self.plain.len() {
            (self.plain, self.taken) = (Vec::new(), 0);
        }
        Some(Ok(len))
    }
}

impl Stream for ServerTlsStream {
    fn poll_read(
        &mut self,
        context: &mut Context<'_>,
        input: &mut [u8],
        unsent: &mut Vec<u8>,
    ) -> Poll<Result<usize, End>> {
        if let Some(taken) = self.take(input) {
            return Poll::Ready(taken);
        }
        SCRATCH.with_borrow_mut(|scratch| {
            let mut buffer = ReadBuf::new(&mut scratch.input);
            let socket = Pin::new(&mut self.socket);
            let Poll::Ready(read) = socket.poll_read(context, &mut buffer) else {
                return Poll::Pending;
            };
            let len = buffer.filled().len();
            match read {
                Err(_) => return Poll::Ready(Err(End::Broken)),
                Ok(()) if len == 0 => return Poll::Ready(Err(End::ByPeer)),
                Ok(()) => {}
            }
            let buffers = (&mut scratch.plain, &mut scratch.output);
            Poll::Ready(self.receive(&scratch.input[..len], buffers, input, unsent))
        })
    }

    fn read_now(&mut self, input: &mut [u8], unsent: &mut Vec<u8>) -> Option<usize> {
        if let Some(taken) = self.take(input) {
            return taken.ok();
        }
        SCRATCH.with_borrow_mut(|scratch| {
            let len = stream::read(&self.socket, &mut scratch.input)?;
            let buffers = (&mut scratch.plain, &mut scratch.output);
            self.receive(&scratch.input[..len], buffers, input, unsent).ok()
        })
    }

    fn has_ended(&self) -> bool {
        let has_read_all = self.taken == self.plain.len();
        has_read_all && (self.ended.is_some() || stream::has_ended(&self.socket))
    }

    fn send(&mut self, output: &[u8], unsent: &mut Vec<u8>) -> Result<(), Kind> {
        SCRATCH.with_borrow_mut(|Scratch { output: records, .. }| {
            records.clear();
            self.channel.send(output, records);
            stream::send(&self.socket, records, unsent)
        })
    }

    fn is_amid_record(&self) -> bool {
        self.records.is_amid()
    }

    fn end(&mut self, unsent: &mut Vec<u8>) {
        self.channel.end(unsent);
    }

    fn socket(&self) -> &TcpStream {
        &self.socket
    }
}

/// Acknowledges what has been received, instead of waiting for a reply that carries the
/// acknowledgement. Often the last message of a handshake comes from the client. A client without
/// TCP_NODELAY sends its first request only once that message is acknowledged: 40 ms later.
fn acknowledge(_socket: &TcpStream) {
    #[cfg(target_os = "linux")]
    let _ = SockRef::from(_socket).set_tcp_quickack(true);
}

fn failed(failure: &TlsFailure) -> End {
    End::TlsFailed(failure.reason())
}

/// Finds the boundaries of records.
#[derive(Debug, Default)]
struct Records {
    header: [u8; HEADER_LEN],
    header_len: usize,
    /// Bytes of the record that are still missing.
    missing: usize,
}

impl Records {
    fn pass(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let passed = if self.missing > 0 {
                let passed = self.missing.min(bytes.len());
                self.missing -= passed;
                passed
            } else {
                let passed = (HEADER_LEN - self.header_len).min(bytes.len());
                let end = self.header_len + passed;
                self.header[self.header_len..end].copy_from_slice(&bytes[..passed]);
                self.header_len = end;
                if end == HEADER_LEN {
                    let [.., high, low] = self.header;
                    self.missing = usize::from(u16::from_be_bytes([high, low]));
                    self.header_len = 0;
                }
                passed
            };
            bytes = &bytes[passed..];
        }
    }

    fn is_amid(&self) -> bool {
        self.header_len > 0 || self.missing > 0
    }
}

#[cfg(test)]
mod tests {
    #[cfg(target_os = "linux")]
    use {
        crate::tls::test_party::{self, Party},
        rustls::version::{TLS12, TLS13},
        std::io::Write,
        std::net::TcpStream as Blocking,
        tokio::net::TcpListener,
    };

    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn after_the_handshake_nothing_waits_for_an_acknowledgement() {
        let party = Party::new();
        let tls = ServerTls::load(&party.files(), None).unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        for version in [&TLS12, &TLS13] {
            let config = party.client(version);
            let is_prompt = runtime.block_on(async {
                let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
                let mut client = Blocking::connect(listener.local_addr().unwrap()).unwrap();
                let (socket, _) = listener.accept().await.unwrap();
                // As on a socket that has just replied: acknowledgements wait for the next reply.
                SockRef::from(&socket).set_tcp_quickack(false).unwrap();
                let mut stream = ServerTlsStream::new(socket, &tls).unwrap();
                let shaking = std::thread::spawn(move || {
                    test_party::connection(&config).complete_io(&mut client).unwrap();
                    client
                });
                stream.handshake(Duration::from_secs(60)).await.unwrap();
                let is_prompt = SockRef::from(&stream.socket).tcp_quickack().unwrap();
                shaking.join().unwrap();
                is_prompt
            });
            assert!(is_prompt, "{version:?}");
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_end_that_a_peer_announces_is_found_behind_what_it_has_sent() {
        let party = Party::new();
        let tls = ServerTls::load(&party.files(), None).unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
            let mut client = Blocking::connect(listener.local_addr().unwrap()).unwrap();
            let (socket, _) = listener.accept().await.unwrap();
            let mut stream = ServerTlsStream::new(socket, &tls).unwrap();
            let config = party.client(&TLS13);
            let shaking = std::thread::spawn(move || {
                let mut channel = test_party::connection(&config);
                channel.complete_io(&mut client).unwrap();
                (channel, client)
            });
            stream.handshake(Duration::from_secs(60)).await.unwrap();
            let (mut channel, mut client) = shaking.join().unwrap();
            channel.writer().write_all(b"four").unwrap();
            channel.write_tls(&mut client).unwrap();
            let (mut input, mut unsent) = ([0; 9], Vec::new());
            assert_eq!(stream.read_now(&mut input, &mut unsent), Some(4));
            assert!(!stream.has_ended());
            channel.send_close_notify();
            channel.write_tls(&mut client).unwrap();
            assert_eq!(stream.read_now(&mut input, &mut unsent), Some(0));
            assert!(stream.has_ended(), "the socket is still open");
        });
    }

    #[test]
    fn record_boundaries_are_found_for_every_split() {
        let stream = [&[23, 3, 3, 0, 2, 8, 9][..], &[21, 3, 3, 0, 0], &[23, 3, 3, 1, 4]].concat();
        let stream = [&stream[..], &[0; 260]].concat();
        let ends = [0, 7, 12, stream.len()];
        for cut in 1..=stream.len() {
            let mut records = Records::default();
            records.pass(&stream[..cut]);
            assert_eq!(records.is_amid(), !ends.contains(&cut), "cut at {cut}");
            records.pass(&stream[cut..]);
            assert!(!records.is_amid(), "cut at {cut}");
        }
    }
}
