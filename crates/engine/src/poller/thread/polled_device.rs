//! A polled device, as seen from outside.

use std::sync::Arc;

use holdfast_protocol::client::Tolerance;

use super::links::{Address, address};
use crate::poller::device::DeviceSettings;
use crate::poller::forwarding::{ForwardCounters, ForwardSettings};
use crate::poller::results::Results;
use crate::poller::state::DeviceState;

#[derive(Clone)]
pub struct Polled {
    pub name: String,
    /// Grows in the order in which devices are added.
    pub(super) number: u64,
    pub state: Arc<DeviceState>,
    pub forwards: Vec<Arc<ForwardCounters>>,
    /// The queue that receives its polls.
    pub report: Option<Arc<Results>>,
    /// The settings of `forwards`.
    receivers: Arc<[ForwardSettings]>,
    pub(super) address: Arc<Address>,
    /// What the device needs. At one address, what the first device needs counts.
    pub(super) tolerance: Tolerance,
}

impl Polled {
    pub(super) fn new(device: &DeviceSettings, number: u64, state: Arc<DeviceState>) -> Polled {
        state.set_stale_after(device.interval, device.timeout);
        let forwards = device.forward.iter().map(|_| Arc::default()).collect();
        let address = Arc::new(address(&device.endpoint));
        Polled {
            name: device.name.clone(),
            number,
            state,
            forwards,
            report: device.report.clone(),
            receivers: device.forward.as_slice().into(),
            address,
            tolerance: device.endpoint.tolerance,
        }
    }

    /// Goes on with the counters of receivers that the device before has too.
    pub(super) fn keep_forwards(&mut self, before: &Polled) {
        let mut known: Vec<_> = before.receivers.iter().zip(&before.forwards).collect();
        for (settings, counters) in self.receivers.iter().zip(&mut self.forwards) {
            if let Some(at) = known.iter().position(|(other, _)| *other == settings) {
                *counters = Arc::clone(known.remove(at).1);
            }
        }
    }
}
