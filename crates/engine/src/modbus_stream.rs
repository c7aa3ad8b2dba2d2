//! Modbus over TCP connections: what a listener for Modbus TCP, with or without TLS, or RTU over TCP,
//! serves.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::time::timeout;

use crate::admission::Ticket;
use crate::connection::{Connection, Timeouts};
use crate::event::Kind;
use crate::framing::{Framing, Mbap, Rtu};
use crate::listener::{Admitted, Front, Limits, Service, drain, set_options};
use crate::policy::{Grant, Policy, Rule};
use crate::station::Station;
use crate::stream::Stream;
use crate::tls::server::ServerTls;
use crate::tls_stream::TlsStream;

/// How a TCP stream carries Modbus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StreamFraming {
    /// Modbus TCP: an MBAP header before each PDU.
    Mbap,
    /// RTU over TCP: frames of a serial line, one behind the other.
    Rtu,
}

/// A listener for Modbus over TCP connections.
#[derive(Debug, Clone)]
pub struct StreamSettings {
    /// Port 0 lets the system pick one. `[::]` takes IPv4 connections too.
    pub bind: SocketAddr,
    pub framing: StreamFraming,
    pub rules: Vec<Rule>,
    pub limits: Limits,
    /// How long a connection may be without a request; `None` keeps it.
    pub idle_timeout: Option<Duration>,
    /// From the first byte of a request to its last, and for a peer to take its replies.
    /// With TLS also for its handshake.
    pub request_timeout: Duration,
    /// `None` is plain TCP.
    pub tls: Option<Arc<ServerTls>>,
}

pub(crate) struct ModbusStream {
    station: Arc<Station>,
    policy: Policy<Grant>,
    timeouts: Timeouts,
    framing: StreamFraming,
    tls: Option<Arc<ServerTls>>,
}

impl ModbusStream {
    pub(crate) fn new(settings: &StreamSettings, station: Arc<Station>) -> ModbusStream {
        ModbusStream {
            station,
            policy: Policy::of(&settings.rules),
            timeouts: Timeouts { idle: settings.idle_timeout, request: settings.request_timeout },
            framing: settings.framing,
            tls: settings.tls.clone(),
        }
    }

    async fn connection<F: Framing>(
        &self,
        front: Arc<Front>,
        admitted: Admitted<Grant>,
        stop: watch::Receiver<bool>,
    ) {
        match &self.tls {
            None => {
                let Admitted { stream, peer, grant, ticket, .. } = admitted;
                self.modbus::<F, _>(front, (stream, peer), grant, ticket, stop).await;
            }
            // Apart, so that a plain connection takes no room for it.
            Some(tls) => Box::pin(self.secure::<F>(tls, front, admitted, stop)).await,
        }
    }

    /// Settles by the peer's certificate what it may do, and serves it.
    async fn secure<F: Framing>(
        &self,
        tls: &ServerTls,
        front: Arc<Front>,
        admitted: Admitted<Grant>,
        mut stop: watch::Receiver<bool>,
    ) {
        let Admitted { stream, peer, ticket, .. } = admitted;
        let mut stream = match TlsStream::new(stream, tls) {
            Ok(stream) => stream,
            Err(end) => return front.ended(end, peer),
        };
        let patience = self.timeouts.request;
        let shaken = tokio::select! {
            biased;
            _ = stop.wait_for(|stop| *stop) => return front.ended(Kind::Closed, peer),
            shaken = timeout(patience, stream.handshake(patience)) => shaken,
        };
        let role = match shaken {
            Ok(Ok(())) => stream.role(),
            Ok(Err(Kind::Closed)) => return front.ended(Kind::TlsFailed("closed"), peer),
            Ok(Err(end)) => Err(end),
            Err(_) => return front.ended(Kind::TlsFailed("timeout"), peer),
        };
        match role {
            Ok(role) => {
                if let Some(grant) = self.policy.grant_of_role(peer.ip(), &role) {
                    let grant = Arc::clone(grant);
                    return self.modbus::<F, _>(front, (stream, peer), grant, ticket, stop).await;
                }
                front.refuse_role(peer, &role);
                stream.say_end();
            }
            Err(end) => front.ended(end, peer),
        }
        drain(&stream.into_socket(), stop).await;
    }

    async fn modbus<F: Framing, S: Stream>(
        &self,
        front: Arc<Front>,
        stream: (S, SocketAddr),
        grant: Arc<Grant>,
        ticket: Ticket,
        stop: watch::Receiver<bool>,
    ) {
        let station = Arc::clone(&self.station);
        let connection =
            Connection::<F, S>::new(front, station, stream, grant, self.timeouts, ticket);
        connection.run(stop).await;
    }
}

impl Service for ModbusStream {
    type Grant = Grant;

    fn grant(&self, peer: IpAddr) -> Option<&Arc<Grant>> {
        self.policy.grant(peer)
    }

    async fn serve(
        self: Arc<Self>,
        front: Arc<Front>,
        connection: Admitted<Grant>,
        stop: watch::Receiver<bool>,
    ) {
        set_options(&connection.stream);
        match self.framing {
            StreamFraming::Mbap => self.connection::<Mbap>(front, connection, stop).await,
            StreamFraming::Rtu => self.connection::<Rtu>(front, connection, stop).await,
        }
    }
}
