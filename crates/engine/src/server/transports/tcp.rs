//! Listeners for Modbus TCP, with or without TLS, RTU over TCP and ASCII over TCP.

use std::io::ErrorKind;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::time::{Instant, timeout_at};

use crate::server::connections::admission::{ConnectionLimits, Ticket};
use crate::server::connections::connection::{Connection, Renewal, Terms};
use crate::server::connections::deadlines::Timeouts;
use crate::server::connections::listener::{
    Admitted, ListenerContext, Service, Serving, set_tcp_options,
};
use crate::server::connections::peer::Peer;
use crate::server::connections::reloadable::Reloadable;
use crate::server::reports::counters::PacketCounters;
use crate::server::reports::event::Kind;
use crate::server::requests::unit_server::{UnitServer, UnitSettings};
use crate::server::rights::peer_rights::PeerRights;
use crate::server::rights::policy::Policy;
use crate::server::rights::rule::Rule;
use crate::server::transports::framing::{Ascii, Framing, Mbap, MbapBesidePackets, Rtu};
use crate::server::transports::raw_ingest::{RawIngest, RawSettings};
use crate::server::transports::secure::secured;
use crate::server::transports::shared_port::{Beginning, DECISIVE_BYTES};
use crate::server::transports::stream::Stream;
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
    /// The time without a byte after which the system asks whether the peer is still there.
    pub keepalive: Duration,
    pub units: UnitSettings,
    /// `None` is plain TCP.
    pub tls: Option<Arc<ServerTls>>,
    /// Raw Ingest packets on the same port, only with MBAP frames over plain TCP.
    pub raw_ingest: Option<RawSettings>,
}

pub(crate) struct ModbusStream {
    unit_server: Arc<UnitServer>,
    policy: Policy,
    timeouts: Timeouts,
    keepalive: Duration,
    framing: StreamFraming,
    tls: Option<Arc<ServerTls>>,
    raw_ingest: Option<Arc<RawIngest>>,
}

impl ModbusStream {
    /// `packets` counts Raw Ingest packets on the same port.
    pub(crate) fn new(
        settings: &StreamSettings,
        unit_server: Arc<UnitServer>,
        packets: Option<Arc<PacketCounters>>,
    ) -> ModbusStream {
        let may_share = settings.framing == StreamFraming::Mbap && settings.tls.is_none();
        debug_assert!(may_share || settings.raw_ingest.is_none());
        ModbusStream {
            raw_ingest: settings
                .raw_ingest
                .as_ref()
                .map(|raw| Arc::new(RawIngest::new(raw, packets.unwrap_or_default()))),
            unit_server,
            policy: Policy::of(&settings.rules),
            timeouts: Timeouts {
                idle: settings.idle_timeout,
                request: settings.request_timeout,
                frame: settings.frame_timeout,
            },
            keepalive: settings.keepalive,
            framing: settings.framing,
            tls: settings.tls.clone(),
        }
    }

    /// The counters of Raw Ingest packets on the same port.
    pub(crate) fn packets(&self) -> Option<Arc<PacketCounters>> {
        self.raw_ingest.as_ref().map(|raw| Arc::clone(&raw.packets))
    }

    fn connection<F: Framing>(
        self: Arc<Self>,
        live: Arc<Reloadable<ModbusStream>>,
        context: Arc<ListenerContext>,
        admitted: Admitted<PeerRights>,
        stop: watch::Receiver<bool>,
    ) -> Serving {
        if let Some(tls) = self.tls.clone() {
            return Box::pin(self.secure::<F>(tls, live, context, admitted, stop));
        }
        let Admitted { stream, peer, rights, ticket, received } = admitted;
        let peer = (stream, peer.into());
        self.modbus::<F, _>(live, context, peer, (rights, received), ticket, stop)
    }

    /// Performs the handshake, selects the rights by the role in the certificate, and serves the
    /// connection.
    async fn secure<F: Framing>(
        self: Arc<Self>,
        tls: Arc<ServerTls>,
        live: Arc<Reloadable<ModbusStream>>,
        context: Arc<ListenerContext>,
        admitted: Admitted<PeerRights>,
        stop: watch::Receiver<bool>,
    ) {
        let Admitted { stream, peer, ticket, .. } = admitted;
        let (time_limit, stopping) = (self.timeouts.request, stop.clone());
        let secured = secured(&tls, &context, (stream, peer), &ticket, time_limit, stopping).await;
        let Some((stream, peer)) = secured else { return };
        if context.end_after_reload((&*self, &*live.get()), (&ticket, &peer), Service::ends) {
            return;
        }
        // A reload reviews connections by their roles. This one looks up its rights only now.
        let rights = live.get().policy.by_certificate(&peer).unwrap_or_else(|nobody| {
            context.report(Kind::RefusedRole, Some(peer.clone()));
            nobody
        });
        self.modbus::<F, _>(live, context, (stream, peer), (rights, Vec::new()), ticket, stop)
            .await;
    }

    fn modbus<F: Framing, S: Stream + 'static>(
        &self,
        live: Arc<Reloadable<ModbusStream>>,
        context: Arc<ListenerContext>,
        (stream, peer): (S, Peer),
        (rights, received): (Arc<PeerRights>, Vec<u8>),
        ticket: Ticket,
        stop: watch::Receiver<bool>,
    ) -> Serving {
        let unit_server = Arc::clone(&self.unit_server);
        let terms = Terms { rights, timeouts: self.timeouts };
        let mut connection =
            Connection::<F, S>::new(context, unit_server, (stream, peer), terms, live, ticket);
        connection.begin_with(&received);
        connection.run(stop)
    }

    /// Serves a connection that may begin with a packet: its first bytes decide.
    async fn shared(
        self: Arc<Self>,
        live: Arc<Reloadable<ModbusStream>>,
        context: Arc<ListenerContext>,
        mut admitted: Admitted<PeerRights>,
        mut stop: watch::Receiver<bool>,
    ) {
        let peer = admitted.peer;
        let begun = Instant::now();
        loop {
            match Beginning::of(&admitted.received) {
                Beginning::Unknown => {}
                Beginning::Modbus => {
                    admitted.ticket.set_amid_exchange(false);
                    return self
                        .connection::<MbapBesidePackets>(live, context, admitted, stop)
                        .await;
                }
                Beginning::Packet => {
                    let Admitted { stream, peer, received, ticket, .. } = admitted;
                    // A reload may have changed the settings of packets, or removed them.
                    let Some(raw) = live.get().raw_ingest.clone() else {
                        return context.ended(Kind::RightsRevoked, peer);
                    };
                    let Some(rights) = raw.rights(peer.ip()) else {
                        ticket.set_answered();
                        return raw.refuse_peer(&context, (stream, peer), &received, stop).await;
                    };
                    let admitted = Admitted { stream, peer, rights, received, ticket };
                    let renewal =
                        Box::new(move || live.get().raw_ingest.as_ref()?.rights(peer.ip()));
                    let sending = raw.sending(admitted);
                    return Box::pin(raw.serve_packets(context, sending, renewal, stop)).await;
                }
            }
            let is_partial = !admitted.received.is_empty();
            let (deadline, end) = self.timeouts.first_request(begun, is_partial);
            let readable = tokio::select! {
                readable = timeout_at(deadline, admitted.stream.readable()) => readable,
                _ = stop.wait_for(|stop| *stop) => return context.ended(Kind::Closed, peer),
            };
            // No more than what decides: the server of the protocol reads the rest.
            let mut chunk = [0; DECISIVE_BYTES];
            let missing = DECISIVE_BYTES - admitted.received.len();
            match readable {
                Err(_) => return context.ended(end, peer),
                Ok(Err(_)) => return context.ended(Kind::Closed, peer),
                Ok(Ok(())) => match admitted.stream.try_read(&mut chunk[..missing]) {
                    Ok(0) => return context.ended(Kind::Closed, peer),
                    Ok(len) => {
                        admitted.received.extend_from_slice(&chunk[..len]);
                        admitted.ticket.set_amid_exchange(true);
                    }
                    Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                    Err(_) => return context.ended(Kind::Closed, peer),
                },
            }
        }
    }
}

impl Renewal for Reloadable<ModbusStream> {
    fn terms(&self, peer: &Peer) -> Option<Terms> {
        let service = self.get();
        let rights = match peer.certificate {
            None => service.rights(peer.ip())?,
            Some(_) => service.policy.by_certificate(peer).unwrap_or_else(|nobody| nobody),
        };
        Some(Terms { rights, timeouts: service.timeouts })
    }
}

impl Service for ModbusStream {
    type PeerRights = PeerRights;

    fn rights(&self, peer: IpAddr) -> Option<Arc<PeerRights>> {
        let rights = self.policy.rights(peer, None);
        rights.or_else(|| {
            let raw = self.raw_ingest.as_ref()?;
            raw.rights(peer).map(|_| Arc::clone(&self.policy.nobody))
        })
    }

    fn ends(&self, before: &ModbusStream, peer: &Peer) -> Option<Kind> {
        let is_other = self.framing != before.framing || self.tls.is_some() != before.tls.is_some();
        if is_other || self.rights(peer.ip()).is_none() {
            return Some(Kind::RightsRevoked);
        }
        let (tls, certificate) = (self.tls.as_ref()?, peer.certificate.as_ref()?);
        if let Err(failure) = tls.judge(certificate) {
            return Some(Kind::TlsFailed(failure.reason()));
        }
        // A session that never had rights keeps its exceptions.
        let had_rights = before.policy.by_certificate(peer).is_ok();
        (had_rights && self.policy.by_certificate(peer).is_err()).then_some(Kind::RightsRevoked)
    }

    fn serve(
        self: Arc<Self>,
        live: Arc<Reloadable<Self>>,
        context: Arc<ListenerContext>,
        connection: Admitted<PeerRights>,
        stop: watch::Receiver<bool>,
    ) -> Serving {
        set_tcp_options(&connection.stream, self.keepalive);
        if self.raw_ingest.is_some() {
            return Box::pin(self.shared(live, context, connection, stop));
        }
        match self.framing {
            StreamFraming::Mbap => self.connection::<Mbap>(live, context, connection, stop),
            StreamFraming::Rtu => self.connection::<Rtu>(live, context, connection, stop),
            StreamFraming::Ascii => self.connection::<Ascii>(live, context, connection, stop),
        }
    }
}
