//! The handshake of an admitted connection.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::timeout;

use crate::server::connections::admission::{Full, Ticket};
use crate::server::connections::closing::drain;
use crate::server::connections::listener::ListenerContext;
use crate::server::connections::peer::Peer;
use crate::server::reports::event::Kind;
use crate::server::transports::tls::ServerTlsStream;
use crate::tls::TlsFailure;
use crate::tls::server::ServerTls;

/// Performs the handshake, and gives the connection its place among the sessions. `None`: the connection
/// has ended, which was counted and reported. In a box, whose memory is free again when this ends.
pub(crate) async fn secured(
    tls: &ServerTls,
    context: &ListenerContext,
    (stream, peer): (TcpStream, SocketAddr),
    ticket: &Ticket,
    time_limit: Duration,
    mut stop: watch::Receiver<bool>,
) -> Option<(ServerTlsStream, Peer)> {
    Box::pin(async move {
        let ended = |end| {
            context.ended(end, peer);
            None
        };
        let mut stream = match ServerTlsStream::new(stream, tls) {
            Ok(stream) => stream,
            Err(end) => return ended(end),
        };
        let shaken = tokio::select! {
            biased;
            _ = stop.wait_for(|stop| *stop) => None,
            shaken = timeout(time_limit, stream.handshake(time_limit)) => Some(shaken),
        };
        let Some(shaken) = shaken else {
            if stream.channel.has_begun() {
                // The peer may have completed its side.
                stream.announce_end();
            }
            return ended(Kind::Closed);
        };
        let certificate = match shaken {
            Ok(Ok(())) => stream.peer_certificate(),
            Ok(Err(Kind::Closed)) => {
                return ended(Kind::TlsFailed(TlsFailure::ClosedDuringHandshake.reason()));
            }
            Ok(Err(end)) => Err(end),
            Err(_) => return ended(Kind::TlsFailed("timeout")),
        };
        let certificate = match certificate {
            Ok(certificate) => certificate.map(Arc::new),
            Err(end) => {
                let subject = stream.channel.presented_subject();
                context.report_with(end, Some(peer.into()), subject.as_deref());
                drain(&mut stream.into_socket(), stop, |_| ()).await;
                return None;
            }
        };
        if let Some(certificate) = &certificate {
            ticket.identify(Arc::clone(certificate));
        }
        let peer = Peer { address: peer, certificate };
        match ticket.establish() {
            Ok(evicted) => context.evicted(evicted),
            Err(Full) => {
                context.ended(Kind::RefusedFull, peer);
                stream.refuse(stop).await;
                return None;
            }
        }
        context.report(Kind::Secured, Some(peer.clone()));
        Some((stream, peer))
    })
    .await
}
