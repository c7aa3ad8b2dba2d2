//! All devices on one thread: they come and go, and are stopped together.

use std::collections::HashMap;
use std::io;
use std::rc::{Rc, Weak};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use thiserror::Error;
use tokio::runtime::Builder;
use tokio::sync::mpsc;
use tokio::task::{AbortHandle, LocalSet, spawn_local};

use super::device::{Device, DeviceSettings, DeviceState, fields};
use super::forward::{Forward, ForwardCounters};
use super::link::Link;
use super::plan::{self, PlanError};
use super::results::Results;
use super::status::BLOCK;
use crate::client::Endpoint;
use crate::tls::client::Identity;

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
    #[error("device {device}: there is one of that name")]
    Taken { device: String },
    #[error("can't start the poller's thread: {0}")]
    Thread(io::Error),
}

/// One device as it can be looked at from outside.
#[derive(Clone)]
pub struct Polled {
    pub name: String,
    pub state: Arc<DeviceState>,
    pub forwards: Vec<Arc<ForwardCounters>>,
}

/// Devices that are polled, until it is stopped or dropped. They may come and go.
pub struct Poller {
    polled: Mutex<Vec<Polled>>,
    orders: mpsc::UnboundedSender<Order>,
    results: Arc<Results>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// What the poller's thread is told; it ends when nobody can tell it anything any more.
enum Order {
    Add(Box<DeviceSettings>, Polled),
    Remove(String),
    Stop,
}

impl Poller {
    /// Checks all devices, then starts to poll. Their first polls are spread.
    ///
    /// # Errors
    /// [`PollerError`], with nothing left running.
    pub fn start(devices: Vec<DeviceSettings>) -> Result<Poller, PollerError> {
        for device in &devices {
            check(device)?;
        }
        let (orders, told) = mpsc::unbounded_channel();
        let results = Arc::new(Results::default());
        let runtime = Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .build()
            .map_err(PollerError::Thread)?;
        let to = Arc::clone(&results);
        let work = move || {
            LocalSet::new().block_on(&runtime, obey(told, to));
            // A name that is being looked up is not waited for.
            runtime.shutdown_background();
        };
        let thread = thread::Builder::new()
            .name("holdfast-poller".into())
            .spawn(work)
            .map_err(PollerError::Thread)?;
        let poller =
            Poller { polled: Mutex::default(), orders, results, thread: Mutex::new(Some(thread)) };
        for device in devices {
            poller.add(device)?;
        }
        Ok(poller)
    }

    /// Polls one more device.
    ///
    /// # Errors
    /// [`PollerError`] for one that can't be polled, or whose name is taken.
    pub fn add(&self, device: DeviceSettings) -> Result<(), PollerError> {
        check(&device)?;
        let polled = Polled {
            name: device.name.clone(),
            state: Arc::new(DeviceState::new(device.interval, device.timeout)),
            forwards: device.forward.iter().map(|_| Arc::default()).collect(),
        };
        let mut all = self.polled.lock().unwrap_or_else(PoisonError::into_inner);
        if all.iter().any(|other| other.name == device.name) {
            return Err(PollerError::Taken { device: device.name });
        }
        all.push(polled.clone());
        let _ = self.orders.send(Order::Add(Box::new(device), polled));
        Ok(())
    }

    /// Stops polling a device; its connection is closed when no other device uses it. Whether there
    /// was one of that name.
    pub fn remove(&self, name: &str) -> bool {
        let mut all = self.polled.lock().unwrap_or_else(PoisonError::into_inner);
        let before = all.len();
        all.retain(|device| device.name != name);
        let _ = self.orders.send(Order::Remove(name.to_owned()));
        all.len() < before
    }

    /// The devices as they are now.
    pub fn devices(&self) -> Vec<Polled> {
        self.polled.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// What devices with `report` answered.
    pub fn results(&self) -> &Results {
        &self.results
    }

    /// Stops polling. What was read has been handed on; a read under way is given up.
    pub fn stop(&self) {
        let _ = self.orders.send(Order::Stop);
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

/// Starts and ends the tasks of devices, until it is told to stop.
async fn obey(mut orders: mpsc::UnboundedReceiver<Order>, results: Arc<Results>) {
    let mut links: HashMap<Address, Weak<Link>> = HashMap::new();
    let mut tasks: HashMap<String, Vec<AbortHandle>> = HashMap::new();
    let mut started = 0;
    while let Some(order) = orders.recv().await {
        match order {
            Order::Stop => return,
            Order::Remove(name) => {
                for task in tasks.remove(&name).unwrap_or_default() {
                    task.abort();
                }
                links.retain(|_, link| link.strong_count() > 0);
            }
            Order::Add(settings, polled) => {
                let phase = spread(settings.start_within, started);
                started += 1;
                let name = settings.name.clone();
                let link = link_to(&settings.endpoint, &mut links);
                tasks.insert(name, start(*settings, polled, link, phase, &results));
            }
        }
    }
}

/// The link to an endpoint, shared with all other devices there.
fn link_to(endpoint: &Endpoint, links: &mut HashMap<Address, Weak<Link>>) -> Rc<Link> {
    let known = links.entry(address(endpoint)).or_default();
    known.upgrade().unwrap_or_else(|| {
        let link = Link::new(endpoint.clone());
        *known = Rc::downgrade(&link);
        link
    })
}

/// The tasks of one device.
fn start(
    settings: DeviceSettings,
    polled: Polled,
    link: Rc<Link>,
    phase: Duration,
    results: &Arc<Results>,
) -> Vec<AbortHandle> {
    let forwards: Vec<_> = settings
        .forward
        .iter()
        .cloned()
        .zip(polled.forwards)
        .map(|(settings, counters)| Forward::new(settings, counters))
        .collect();
    let mut tasks: Vec<AbortHandle> = forwards
        .iter()
        .map(|forward| spawn_local(Rc::clone(forward).run()).abort_handle())
        .collect();
    let report = settings.report.then(|| Arc::clone(results));
    let device = Device::new(settings, polled.state, link, forwards, report);
    tasks.push(spawn_local(device.run(phase)).abort_handle());
    tasks
}

/// When the device that was started as number `number` begins: by the golden ratio, which spreads
/// any number of them evenly.
fn spread(within: Duration, number: u32) -> Duration {
    within.mul_f64((f64::from(number) * 0.618_033_988_749_895).fract())
}

/// What devices share a link by: where it goes to, and whom it trusts there.
type Address = (String, Option<Arc<Identity>>);

fn address(endpoint: &Endpoint) -> Address {
    match endpoint {
        Endpoint::Tcp { host, port, tls } => {
            let identity = tls.as_ref().map(|tls| Arc::clone(tls.identity()));
            (format!("tcp://{host}:{port}"), identity)
        }
        Endpoint::RtuOverTcp { host, port } => (format!("rtu+tcp://{host}:{port}"), None),
        Endpoint::Udp { host, port } => (format!("udp://{host}:{port}"), None),
        Endpoint::Serial { line, .. } => (format!("serial:{}", line.device), None),
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
