//! Modbus over UDP: one request a datagram, one reply.

use std::net::SocketAddr;
use std::sync::Arc;

use holdfast_protocol::frame::mbap;
use holdfast_protocol::pdu;
use tokio::net::UdpSocket;
use tokio::sync::watch;

use crate::framing::{Framing, Mbap, Next};
use crate::listener::Front;
use crate::policy::{Grant, Policy, Rule};
use crate::station::Station;

/// How many datagrams are answered that wait when all are to stop.
const LAST_DATAGRAMS: usize = 1024;

/// A listener for Modbus datagrams.
#[derive(Debug, Clone)]
pub struct UdpSettings {
    /// Port 0 lets the system pick one. `[::]` takes IPv4 datagrams too.
    pub bind: SocketAddr,
    pub rules: Vec<Rule>,
}

pub(crate) struct ModbusUdp {
    station: Arc<Station>,
    policy: Policy<Grant>,
}

impl ModbusUdp {
    pub(crate) fn new(settings: &UdpSettings, station: Arc<Station>) -> ModbusUdp {
        ModbusUdp { station, policy: Policy::of(&settings.rules) }
    }

    /// Answers datagrams until `stop`, then those that the system has received already.
    pub(crate) async fn serve(
        self,
        front: Arc<Front>,
        socket: std::net::UdpSocket,
        mut stop: watch::Receiver<bool>,
    ) {
        let Ok(socket) = UdpSocket::from_std(socket) else {
            return;
        };
        // One byte more than the longest request: a longer datagram shows.
        let (mut input, mut output) = ([0; mbap::MAX_LEN + 1], [0; mbap::MAX_LEN]);
        loop {
            let received = tokio::select! {
                biased;
                _ = stop.wait_for(|stop| *stop) => break,
                received = socket.recv_from(&mut input) => received,
            };
            // An error tells of an earlier reply that could not be delivered.
            let Ok((len, peer)) = received else { continue };
            let len = self.answer(&front, peer, &input[..len], &mut output);
            if len > 0 {
                // A reply that the system has no room for is lost, as any datagram can be.
                let _ = socket.try_send_to(&output[..len], peer);
            }
        }
        let Ok(socket) = socket.into_std() else { return };
        for _ in 0..LAST_DATAGRAMS {
            let Ok((len, peer)) = socket.recv_from(&mut input) else { break };
            let len = self.answer(&front, peer, &input[..len], &mut output);
            if len > 0 {
                let _ = socket.send_to(&output[..len], peer);
            }
        }
    }

    /// The length of the reply, 0 when none is due.
    fn answer(
        &self,
        front: &Front,
        peer: SocketAddr,
        datagram: &[u8],
        output: &mut [u8; mbap::MAX_LEN],
    ) -> usize {
        let Some(grant) = self.policy.grant(peer.ip()) else {
            front.refuse_source(peer);
            return 0;
        };
        let frames = &self.station.counters.frames;
        let (tag, unit_id, request) = match Mbap::next(datagram) {
            Next::Request { tag, unit_id, pdu, len } if len == datagram.len() => {
                (tag, unit_id, pdu)
            }
            Next::Foreign { .. } => {
                frames.foreign.add();
                return 0;
            }
            _ => {
                frames.broken.add();
                return 0;
            }
        };
        let Some(buffer) = output[Mbap::HEADER_LEN..].first_chunk_mut::<{ pdu::MAX_LEN }>() else {
            return 0;
        };
        let len = self.station.answer(grant, unit_id, request, buffer);
        if let Some(auditor) = &front.auditor {
            let reply = &buffer[..len.unwrap_or_default()];
            auditor.note(&front.name, Some(peer), unit_id, request, reply);
        }
        len.map_or(0, |len| Mbap::complete(output, tag, unit_id, len))
    }
}
