//! Listeners for Modbus TCP, with or without TLS, RTU over TCP and ASCII over TCP.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::time::timeout;

use super::admission::ConnectionLimits;
use super::admission::Ticket;
use super::connection::{Connection, Timeouts};
use super::event::Kind;
use super::framing::{Ascii, Framing, Mbap, Rtu};
use super::listener::{Admitted, ListenerContext, Service, drain, set_options};
use super::policy::{PeerRights, Policy, Rule};
use super::stream::Stream;
use super::tls::ServerTlsStream;
use super::unit_server::UnitServer;
use crate::tls::TlsFailure;
use crate::tls::server::ServerTls;

/// The framing of Modbus on a TCP stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StreamFraming {
    /// Modbus TCP: an MBAP header before each PDU.
    Mbap,
    /// RTU over TCP: RTU frames, one after another.
    Rtu,
    /// ASCII over TCP: ASCII frames, one after another.
    Ascii,
}

/// A listener for Modbus over TCP connections.
#[derive(Debug, Clone)]
pub struct StreamSettings {
    /// With port 0, the system picks a port. `[::]` also accepts IPv4 connections.
    pub bind: SocketAddr,
    pub framing: StreamFraming,
    pub rules: Vec<Rule>,
    pub limits: ConnectionLimits,
    /// Closes a connection after this time without a request. `None`: never.
    pub idle_timeout: Option<Duration>,
    /// The longest time from the first byte of a request to its last, and for a peer to read its
    /// replies. With TLS also for the handshake.
    pub request_timeout: Duration,
    /// With RTU frames: the silence after which an incomplete request may be followed by the next.
    pub frame_timeout: Option<Duration>,
    /// `None` is plain TCP.
    pub tls: Option<Arc<ServerTls>>,
}

pub(crate) struct ModbusStream {
    unit_server: Arc<UnitServer>,
    policy: Policy,
    /// The rights of a peer that no rule names, by its role.
    nobody: Arc<PeerRights>,
    timeouts: Timeouts,
    framing: StreamFraming,
    tls: Option<Arc<ServerTls>>,
}

impl ModbusStream {
    pub(crate) fn new(settings: &StreamSettings, unit_server: Arc<UnitServer>) -> ModbusStream {
        ModbusStream {
            unit_server,
            policy: Policy::of(&settings.rules),
            nobody: Arc::new(PeerRights::none()),
            timeouts: Timeouts {
                idle: settings.idle_timeout,
                request: settings.request_timeout,
                frame: settings.frame_timeout,
            },
            framing: settings.framing,
            tls: settings.tls.clone(),
        }
    }

    async fn connection<F: Framing>(
        &self,
        context: Arc<ListenerContext>,
        admitted: Admitted<PeerRights>,
        stop: watch::Receiver<bool>,
    ) {
        match &self.tls {
            None => {
                let Admitted { stream, peer, rights, ticket, .. } = admitted;
                self.modbus::<F, _>(context, (stream, peer), rights, ticket, stop).await;
            }
            // In a box of its own, so that plain connections do not reserve memory for it.
            Some(tls) => Box::pin(self.secure::<F>(tls, context, admitted, stop)).await,
        }
    }

    /// Performs the handshake, selects the rights by the role in the certificate, and serves the
    /// connection.
    async fn secure<F: Framing>(
        &self,
        tls: &ServerTls,
        context: Arc<ListenerContext>,
        admitted: Admitted<PeerRights>,
        mut stop: watch::Receiver<bool>,
    ) {
        let Admitted { stream, peer, ticket, .. } = admitted;
        let mut stream = match ServerTlsStream::new(stream, tls) {
            Ok(stream) => stream,
            Err(end) => return context.ended(end, peer),
        };
        let patience = self.timeouts.request;
        let shaken = tokio::select! {
            biased;
            _ = stop.wait_for(|stop| *stop) => return context.ended(Kind::Closed, peer),
            shaken = timeout(patience, stream.handshake(patience)) => shaken,
        };
        let role = match shaken {
            Ok(Ok(())) => stream.role(),
            Ok(Err(Kind::Closed)) => {
                let reason = TlsFailure::ClosedDuringHandshake.event_reason();
                return context.ended(Kind::TlsFailed(reason), peer);
            }
            Ok(Err(end)) => Err(end),
            Err(_) => return context.ended(Kind::TlsFailed("timeout"), peer),
        };
        let role = match role {
            Ok(role) => role,
            Err(end) => {
                context.ended(end, peer);
                return drain(&stream.into_socket(), stop).await;
            }
        };
        let rights = self.policy.rights_of_role(peer.ip(), &role).unwrap_or_else(|| {
            // The session stays, and each request gets exception 01 (MB-TCP-Security, R-23, R-31).
            context.refuse_role(peer, &role);
            Arc::clone(&self.nobody)
        });
        self.modbus::<F, _>(context, (stream, peer), rights, ticket, stop).await;
    }

    async fn modbus<F: Framing, S: Stream>(
        &self,
        context: Arc<ListenerContext>,
        stream: (S, SocketAddr),
        rights: Arc<PeerRights>,
        ticket: Ticket,
        stop: watch::Receiver<bool>,
    ) {
        let unit_server = Arc::clone(&self.unit_server);
        let connection =
            Connection::<F, S>::new(context, unit_server, stream, rights, self.timeouts, ticket);
        connection.run(stop).await;
    }
}

impl Service for ModbusStream {
    type PeerRights = PeerRights;

    fn rights(&self, peer: IpAddr) -> Option<Arc<PeerRights>> {
        self.policy.rights(peer)
    }

    async fn serve(
        self: Arc<Self>,
        context: Arc<ListenerContext>,
        connection: Admitted<PeerRights>,
        stop: watch::Receiver<bool>,
    ) {
        set_options(&connection.stream);
        match self.framing {
            StreamFraming::Mbap => self.connection::<Mbap>(context, connection, stop).await,
            StreamFraming::Rtu => self.connection::<Rtu>(context, connection, stop).await,
            StreamFraming::Ascii => self.connection::<Ascii>(context, connection, stop).await,
        }
    }
}
