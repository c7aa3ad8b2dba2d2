//! All devices on one thread: they come and go, and are stopped together.

use std::collections::HashMap;
use std::io;
use std::rc::{Rc, Weak};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use holdfast_protocol::pdu::EncodedRequest;
use thiserror::Error;
use tokio::runtime::Builder;
use tokio::sync::mpsc;
use tokio::task::{AbortHandle, LocalSet, spawn_local};

use super::device::{Device, DeviceSettings, DeviceState, Inbox, Turn, fields};
use super::forward::{Forward, ForwardCounters};
use super::link::{Link, Priority};
use super::plan::{self, PlanError};
use super::results::{Results, Written};
use super::status::{Fault, STATUS_BLOCK_LEN};
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
    #[error("device {device}: there is none of that name")]
    Unknown { device: String },
    #[error("device {device}: function {function} does not write")]
    NoWrite { device: String, function: u8 },
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

impl Polled {
    fn new(device: &DeviceSettings, state: Arc<DeviceState>) -> Polled {
        state.set_stale_after(device.interval, device.timeout);
        let forwards = device.forward.iter().map(|_| Arc::default()).collect();
        Polled { name: device.name.clone(), state, forwards }
    }
}

/// Devices that are polled, until it is stopped or dropped. They may come and go.
pub struct Poller {
    polled: Mutex<Vec<Polled>>,
    orders: mpsc::UnboundedSender<Order>,
    results: Arc<Results>,
    tickets: AtomicU64,
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// What the poller's thread is told; it ends when nobody can tell it anything any more.
enum Order {
    Add(Box<DeviceSettings>, Polled),
    /// The device of that name gives way to another one.
    Replace {
        name: String,
        device: Box<DeviceSettings>,
        polled: Polled,
        at_once: bool,
    },
    Remove(String),
    Write {
        device: String,
        ticket: u64,
        request: Box<EncodedRequest>,
    },
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
            LocalSet::new().block_on(&runtime, obey(told, Arc::clone(&to)));
            to.end();
            // A name that is being looked up is not waited for.
            runtime.shutdown_background();
        };
        let thread = thread::Builder::new()
            .name("holdfast-poller".into())
            .spawn(work)
            .map_err(PollerError::Thread)?;
        let poller = Poller {
            polled: Mutex::default(),
            orders,
            results,
            tickets: AtomicU64::default(),
            thread: Mutex::new(Some(thread)),
        };
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
        let mut all = self.polled();
        if all.iter().any(|other| other.name == device.name) {
            return Err(PollerError::Taken { device: device.name });
        }
        let polled = Polled::new(&device, Arc::default());
        all.push(polled.clone());
        let _ = self.orders.send(Order::Add(Box::new(device), polled));
        Ok(())
    }

    /// Polls a device in the place of the one called `name`, whose poll under way is completed. It
    /// may have the same name. It keeps counters, connection and schedule. `at_once` it reads once
    /// beside the schedule; not more often than each second, or each interval if that is shorter.
    ///
    /// # Errors
    /// [`PollerError`]; then nothing has changed.
    pub fn replace(
        &self,
        name: &str,
        device: DeviceSettings,
        at_once: bool,
    ) -> Result<(), PollerError> {
        check(&device)?;
        let mut all = self.polled();
        if device.name != name && all.iter().any(|other| other.name == device.name) {
            return Err(PollerError::Taken { device: device.name });
        }
        let Some(before) = all.iter_mut().find(|other| other.name == name) else {
            return Err(PollerError::Unknown { device: name.to_owned() });
        };
        *before = Polled::new(&device, Arc::clone(&before.state));
        let polled = before.clone();
        let (name, device) = (name.to_owned(), Box::new(device));
        let _ = self.orders.send(Order::Replace { name, device, polled, at_once });
        Ok(())
    }

    /// Sends a write to a device by its own connection. What becomes of it comes by
    /// [`Poller::results`] under the number that is returned.
    ///
    /// # Errors
    /// [`PollerError`] for a device that is not there, or a request that is no write.
    pub fn write(&self, name: &str, request: Box<EncodedRequest>) -> Result<u64, PollerError> {
        let function = request.request().function();
        if !function.is_write() {
            return Err(PollerError::NoWrite {
                device: name.to_owned(),
                function: function.code(),
            });
        }
        if !self.polled().iter().any(|device| device.name == name) {
            return Err(PollerError::Unknown { device: name.to_owned() });
        }
        let ticket = self.tickets.fetch_add(1, Ordering::Relaxed);
        let _ = self.orders.send(Order::Write { device: name.to_owned(), ticket, request });
        Ok(ticket)
    }

    /// Stops polling a device; its connection is closed when no other device uses it. Whether there
    /// was one of that name.
    pub fn remove(&self, name: &str) -> bool {
        let mut all = self.polled();
        let before = all.len();
        all.retain(|device| device.name != name);
        let _ = self.orders.send(Order::Remove(name.to_owned()));
        all.len() < before
    }

    /// The devices as they are now.
    pub fn devices(&self) -> Vec<Polled> {
        self.polled().clone()
    }

    fn polled(&self) -> MutexGuard<'_, Vec<Polled>> {
        self.polled.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What devices with `report` answered, and what became of writes.
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

/// What the poller's thread knows of a device that is polled.
struct Running {
    link: Rc<Link>,
    turn: Rc<Turn>,
    unit_id: u8,
    timeout: Duration,
    release: bool,
    inbox: Rc<Inbox>,
    device: AbortHandle,
    forwards: Vec<AbortHandle>,
}

impl Drop for Running {
    fn drop(&mut self) {
        self.device.abort();
        self.stop_forwards();
    }
}

/// Starts and ends the tasks of devices, until it is told to stop.
async fn obey(mut orders: mpsc::UnboundedReceiver<Order>, results: Arc<Results>) {
    let mut links: HashMap<Address, Weak<Link>> = HashMap::new();
    let mut running: HashMap<String, Running> = HashMap::new();
    let mut started = 0;
    while let Some(order) = orders.recv().await {
        match order {
            Order::Stop => return,
            Order::Remove(name) => {
                running.remove(&name);
                links.retain(|_, link| link.strong_count() > 0);
            }
            Order::Add(settings, polled) => {
                let phase = spread(settings.start_within, started);
                started += 1;
                let name = settings.name.clone();
                let link = link_to(&settings.endpoint, &mut links);
                running.insert(name, Running::start(*settings, polled, link, phase, &results));
            }
            Order::Replace { name, device: settings, polled, at_once } => {
                let link = link_to(&settings.endpoint, &mut links);
                // It is there as long as nobody removes it.
                if let Some(mut device) = running.remove(&name) {
                    let name = settings.name.clone();
                    device.replace(*settings, polled, link, at_once, &results);
                    running.insert(name, device);
                }
                links.retain(|_, link| link.strong_count() > 0);
            }
            Order::Write { device, ticket, request } => match running.get(&device) {
                Some(device) => device.write(ticket, request, &results),
                None => results.push_write(Written { ticket, outcome: Err(Fault::Reset) }),
            },
        }
    }
}

impl Running {
    /// Starts the tasks of a device.
    fn start(
        settings: DeviceSettings,
        polled: Polled,
        link: Rc<Link>,
        phase: Duration,
        results: &Arc<Results>,
    ) -> Running {
        let inbox = Rc::new(Inbox::default());
        let DeviceSettings { unit_id, timeout, release, .. } = settings;
        let turn = Rc::new(Turn::default());
        let to = (Rc::clone(&link), Rc::clone(&turn));
        let (device, forwards) = made(settings, polled, to, results);
        let device = spawn_local(device.run(phase, Rc::clone(&inbox))).abort_handle();
        Running { link, turn, unit_id, timeout, release, inbox, device, forwards }
    }

    fn replace(
        &mut self,
        settings: DeviceSettings,
        polled: Polled,
        link: Rc<Link>,
        at_once: bool,
        results: &Arc<Results>,
    ) {
        self.stop_forwards();
        (self.unit_id, self.timeout) = (settings.unit_id, settings.timeout);
        (self.release, self.link) = (settings.release, Rc::clone(&link));
        let (device, forwards) = made(settings, polled, (link, Rc::clone(&self.turn)), results);
        self.forwards = forwards;
        if at_once {
            device.want_soon();
        }
        self.inbox.succeed(device);
    }

    /// Writes between two reads, as soon as it can; the end of the device does not break it off.
    fn write(&self, ticket: u64, request: Box<EncodedRequest>, results: &Arc<Results>) {
        let (link, turn) = (Rc::clone(&self.link), Rc::clone(&self.turn));
        let inbox = Rc::clone(&self.inbox);
        let results = Arc::clone(results);
        let Running { unit_id, timeout, release, .. } = *self;
        spawn_local(async move {
            let turn = turn.lock().await;
            let answer = link.call(unit_id, &request, timeout, Priority::Urgent).await;
            drop(turn);
            if release {
                link.release();
            }
            if answer.is_ok() {
                inbox.wake();
            }
            results.push_write(Written { ticket, outcome: answer.map(drop) });
        });
    }

    fn stop_forwards(&mut self) {
        for task in self.forwards.drain(..) {
            task.abort();
        }
    }
}

/// A device, and the tasks that forward what it reads.
fn made(
    settings: DeviceSettings,
    polled: Polled,
    to: (Rc<Link>, Rc<Turn>),
    results: &Arc<Results>,
) -> (Device, Vec<AbortHandle>) {
    let forwards: Vec<_> = settings
        .forward
        .iter()
        .cloned()
        .zip(polled.forwards)
        .map(|(settings, counters)| Forward::new(settings, counters))
        .collect();
    let tasks = forwards.iter().map(|forward| spawn_local(Rc::clone(forward).run()).abort_handle());
    let tasks = tasks.collect();
    let report = settings.report.then(|| Arc::clone(results));
    (Device::new(settings, polled.state, to, forwards, report), tasks)
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
        let first = u32::from(status.slot) * u32::from(STATUS_BLOCK_LEN);
        if status.area.is_bits() || first < start || first + u32::from(STATUS_BLOCK_LEN) > end {
            return Err(PollerError::Status { device: name() });
        }
    }
    let parted = fields(&device.reads, &device.limits);
    let fields: Vec<_> = parted.iter().map(|(field, ..)| *field).collect();
    plan::plan(&fields, &device.limits, device.strategy)
        .map(drop)
        .map_err(|error| PollerError::Plan { device: name(), error })
}
