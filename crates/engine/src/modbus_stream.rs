//! Modbus over TCP connections: what a listener for Modbus TCP, or RTU over TCP, serves.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;

use crate::connection::{Connection, Timeouts};
use crate::framing::{Framing, Mbap, Rtu};
use crate::listener::{Admitted, Front, Limits, Service, set_options};
use crate::policy::{Grant, Policy, Rule};
use crate::station::Station;

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
    pub request_timeout: Duration,
}

pub(crate) struct ModbusStream {
    station: Arc<Station>,
    policy: Policy<Grant>,
    timeouts: Timeouts,
    framing: StreamFraming,
}

impl ModbusStream {
    pub(crate) fn new(settings: &StreamSettings, station: Arc<Station>) -> ModbusStream {
        ModbusStream {
            station,
            policy: Policy::of(&settings.rules),
            timeouts: Timeouts { idle: settings.idle_timeout, request: settings.request_timeout },
            framing: settings.framing,
        }
    }

    async fn connection<F: Framing>(
        &self,
        front: Arc<Front>,
        admitted: Admitted<Grant>,
        stop: watch::Receiver<bool>,
    ) {
        let Admitted { stream, peer, grant, ticket, .. } = admitted;
        let (station, timeouts) = (Arc::clone(&self.station), self.timeouts);
        let connection =
            Connection::<F>::new(front, station, (stream, peer), grant, timeouts, ticket);
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
