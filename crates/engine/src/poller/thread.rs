//! All devices on one thread: started together, stopped together.

use std::collections::HashMap;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use thiserror::Error;
use tokio::runtime::Builder;
use tokio::sync::oneshot;
use tokio::task::LocalSet;

use super::device::{Device, DeviceSettings, DeviceState, fields};
use super::forward::{Forward, ForwardCounters};
use super::link::Link;
use super::plan::{self, PlanError};
use super::status::BLOCK;
use crate::client::Endpoint;

#[derive(Debug, Error)]
pub enum PollerError {
    #[error("device {device}: {error}")]
    Plan { device: String, error: PlanError },
    #[error("device {device}: read {read} does not fit into its destination")]
    Destination { device: String, read: usize },
    #[error("device {device}: the status block does not fit into its memory")]
    Status { device: String },
    #[error("device {device}: read {read} goes beyond address 65535")]
    Beyond { device: String, read: usize },
    #[error("can't start the poller's thread: {0}")]
    Thread(io::Error),
}

/// One device as it can be looked at from outside.
pub struct Polled {
    pub name: String,
    pub state: Arc<DeviceState>,
    pub forwards: Vec<Arc<ForwardCounters>>,
}

/// Devices that are polled, until it is stopped or dropped.
pub struct Poller {
    polled: Vec<Polled>,
    stop: Mutex<Option<oneshot::Sender<()>>>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Poller {
    /// Checks all devices, then starts to poll. Their first polls are spread over an interval.
    ///
    /// # Errors
    /// [`PollerError`], with nothing left running.
    pub fn start(devices: Vec<DeviceSettings>) -> Result<Poller, PollerError> {
        for device in &devices {
            check(device)?;
        }
        let polled: Vec<Polled> = devices
            .iter()
            .map(|device| Polled {
                name: device.name.clone(),
                state: Arc::default(),
                forwards: device.forward.iter().map(|_| Arc::default()).collect(),
            })
            .collect();
        let handles: Vec<_> =
            polled.iter().map(|each| (Arc::clone(&each.state), each.forwards.clone())).collect();
        let (stop, stopped) = oneshot::channel();
        let runtime = Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .build()
            .map_err(PollerError::Thread)?;
        let work = move || {
            let local = LocalSet::new();
            local.block_on(&runtime, async move {
                start_all(devices, handles);
                let _ = stopped.await;
            });
        };
        let thread = thread::Builder::new()
            .name("holdfast-poller".into())
            .spawn(work)
            .map_err(PollerError::Thread)?;
        Ok(Poller { polled, stop: Mutex::new(Some(stop)), thread: Mutex::new(Some(thread)) })
    }

    pub fn devices(&self) -> &[Polled] {
        &self.polled
    }

    /// Stops polling. What was read has been handed on; a read under way is given up.
    pub fn stop(&self) {
        drop(self.stop.lock().unwrap_or_else(PoisonError::into_inner).take());
        if let Some(thread) = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take() {
            let _ = thread.join();
        }
    }
}

impl Drop for Poller {
    fn drop(&mut self) {
        self.stop();
    }
}

type Handles = Vec<(Arc<DeviceState>, Vec<Arc<ForwardCounters>>)>;

/// In the context of a `LocalSet`.
fn start_all(devices: Vec<DeviceSettings>, handles: Handles) {
    let mut links: HashMap<String, std::rc::Rc<Link>> = HashMap::new();
    let total = devices.len().max(1) as u32;
    for (number, (settings, (state, counters))) in devices.into_iter().zip(handles).enumerate() {
        let link = links
            .entry(address(&settings.endpoint))
            .or_insert_with(|| Link::new(settings.endpoint.clone()))
            .clone();
        let forwards: Vec<_> = settings
            .forward
            .iter()
            .cloned()
            .zip(counters)
            .map(|(settings, counters)| Forward::new(settings, counters))
            .collect();
        for forward in &forwards {
            tokio::task::spawn_local(std::rc::Rc::clone(forward).run());
        }
        let phase = spread(settings.interval, number as u32, total);
        let device = Device::new(settings, state, link, forwards);
        tokio::task::spawn_local(device.run(phase));
    }
}

/// The start of a device among `total`, so that they don't fire at once.
fn spread(interval: Duration, number: u32, total: u32) -> Duration {
    interval.mul_f64(f64::from(number) / f64::from(total))
}

/// What devices share a link by.
fn address(endpoint: &Endpoint) -> String {
    match endpoint {
        Endpoint::Tcp { host, port } => format!("tcp://{host}:{port}"),
        Endpoint::RtuOverTcp { host, port } => format!("rtu+tcp://{host}:{port}"),
        Endpoint::Udp { host, port } => format!("udp://{host}:{port}"),
        Endpoint::Serial { line, .. } => format!("serial:{}", line.device),
    }
}

fn check(device: &DeviceSettings) -> Result<(), PollerError> {
    let name = || device.name.clone();
    for (read, settings) in device.reads.iter().enumerate() {
        if u32::from(settings.address) + settings.count > 65_536 || settings.count == 0 {
            return Err(PollerError::Beyond { device: name(), read });
        }
        let alike = |into: &super::Destination| {
            into.area.is_bits() == settings.area.is_bits() && into.holds(settings.count)
        };
        if !settings.into.as_ref().is_none_or(alike) {
            return Err(PollerError::Destination { device: name(), read });
        }
    }
    if let Some(status) = &device.status {
        let span = status.memory.span(status.area);
        let (start, end) = (u32::from(span.start()), u32::from(span.start()) + span.size());
        let first = u32::from(status.slot) * u32::from(BLOCK);
        if status.area.is_bits() || first < start || first + u32::from(BLOCK) > end {
            return Err(PollerError::Status { device: name() });
        }
    }
    let parted = fields(&device.reads, &device.limits);
    let fields: Vec<_> = parted.iter().map(|(field, ..)| *field).collect();
    plan::plan(&fields, &device.limits, device.strategy)
        .map(drop)
        .map_err(|error| PollerError::Plan { device: name(), error })
}
