//! Runs all devices on one thread. Devices can be added and removed, and are stopped together.

mod device_checks;
mod error;
mod links;
mod polled_device;
mod running_device;

use std::collections::{HashMap, HashSet};
use std::ptr;
use std::rc::Rc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::thread;
use std::time::{Duration, Instant};

use holdfast_memory::Memory;
use holdfast_protocol::pdu::EncodedRequest;
use holdfast_runtime::{OwnThreads, lock, suspend_aware_time};
use tokio::runtime::Builder;
use tokio::sync::mpsc;
use tokio::task::{LocalSet, spawn_local};

use self::device_checks::checked;
pub use self::error::PollerError;
use self::links::{Address, Links, address};
pub use self::polled_device::Polled;
use self::running_device::RunningDevice;
use super::device::{DeviceSettings, Planned};
use super::results::{Receivers, Results, Written};
use super::schedule;
use super::write_through::{Passage, PassedRange, PassedWrite};
use crate::client::Endpoint;
use crate::heartbeat::Heartbeat;
use crate::link::{Call, Fault, Fence, LinkSettings, SharedLink, serve, standstill};

/// A running poller, until it is stopped or dropped. Devices can be added and removed.
pub struct Poller {
    polled: Mutex<HashMap<String, Polled>>,
    /// The number of the next device.
    numbers: AtomicU64,
    commands: mpsc::UnboundedSender<Command>,
    receivers: Arc<Receivers>,
    tickets: AtomicU64,
    /// Writes of Modbus clients into what is read from devices.
    passed: mpsc::UnboundedSender<PassedWrite>,
    /// The links that listeners use.
    shared: Mutex<Vec<(Address, Weak<SharedLink>)>>,
    thread: OwnThreads,
    heartbeat: Arc<Heartbeat>,
}

/// Commands to the thread of the poller. The thread ends when all senders are dropped.
enum Command {
    Add(Box<Planned>, Polled),
    /// Replaces the device of that name.
    Replace {
        name: String,
        device: Box<Planned>,
        polled: Polled,
        at_once: bool,
    },
    Remove(String),
    /// The next user of the address gets a new link.
    Forget(Address),
    /// Serves a link that listeners use.
    Serve(Box<LinkSettings>, Weak<SharedLink>, mpsc::UnboundedReceiver<Call>),
    Write {
        device: String,
        ticket: u64,
        request: Box<EncodedRequest>,
        /// When it came, by [`suspend_aware_time`].
        queued: Duration,
        until: Option<Instant>,
        to: Arc<Results>,
    },
    Stop,
}

impl Poller {
    /// Checks all devices, then starts to poll. First polls are spread over time.
    ///
    /// # Errors
    /// [`PollerError`]. Nothing is left running then.
    pub fn start(devices: Vec<DeviceSettings>) -> Result<Poller, PollerError> {
        let devices = devices.into_iter().map(checked).collect::<Result<Vec<_>, _>>()?;
        let (commands, received) = mpsc::unbounded_channel();
        let (passed, writes) = mpsc::unbounded_channel();
        let receivers = Arc::new(Receivers::default());
        let runtime = Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .build()
            .map_err(PollerError::Thread)?;
        let heartbeat = Arc::new(Heartbeat::new("holdfast-poller"));
        let (ended, own) = (Arc::clone(&receivers), Arc::clone(&heartbeat));
        let work = move || {
            let work = own.during(run_commands(received, writes));
            LocalSet::new().block_on(&runtime, work);
            ended.end();
            // Does not wait for name resolution in progress.
            runtime.shutdown_background();
        };
        let thread = thread::Builder::new()
            .name(heartbeat.thread().to_owned())
            .spawn(work)
            .map_err(PollerError::Thread)?;
        let threads = OwnThreads::default();
        threads.push(thread);
        let poller = Poller {
            polled: Mutex::default(),
            numbers: AtomicU64::default(),
            commands,
            receivers,
            tickets: AtomicU64::default(),
            passed,
            shared: Mutex::default(),
            thread: threads,
            heartbeat,
        };
        for device in devices {
            poller.begin(device)?;
        }
        Ok(poller)
    }

    /// The heartbeat of the thread.
    pub fn heartbeat(&self) -> &Heartbeat {
        &self.heartbeat
    }

    /// Polls one more device.
    ///
    /// # Errors
    /// [`PollerError`] if the device cannot be polled, or its name is in use.
    pub fn add(&self, device: DeviceSettings) -> Result<(), PollerError> {
        self.begin(checked(device)?)
    }

    fn begin(&self, device: Planned) -> Result<(), PollerError> {
        let mut all = lock(&self.polled);
        let settings = &device.settings;
        if all.contains_key(&settings.name) {
            return Err(PollerError::Taken { device: settings.name.clone() });
        }
        let number = self.numbers.fetch_add(1, Ordering::Relaxed);
        let polled = Polled::new(settings, number, Arc::default());
        self.send(Command::Add(Box::new(device), polled.clone()))?;
        all.insert(polled.name.clone(), polled);
        Ok(())
    }

    fn send(&self, command: Command) -> Result<(), PollerError> {
        self.commands.send(command).map_err(|_| PollerError::Stopped)
    }

    /// Replaces the device called `name` after its current poll. The new device may have the same
    /// name. It keeps counters, connection, schedule and what waits for its receivers. With `at_once`,
    /// it also reads once outside the schedule; at most once per second, or per interval if that is
    /// shorter.
    ///
    /// # Errors
    /// [`PollerError`]. Nothing has changed then.
    pub fn replace(
        &self,
        name: &str,
        device: DeviceSettings,
        at_once: bool,
    ) -> Result<(), PollerError> {
        let device = checked(device)?;
        let settings = &device.settings;
        let mut all = lock(&self.polled);
        if settings.name != name && all.contains_key(&settings.name) {
            return Err(PollerError::Taken { device: settings.name.clone() });
        }
        let Some(before) = all.get(name) else {
            return Err(PollerError::Unknown { device: name.to_owned() });
        };
        let mut polled = Polled::new(settings, before.number, Arc::clone(&before.state));
        polled.keep_forwards(before);
        let device = Box::new(device);
        let sent = polled.clone();
        self.send(Command::Replace { name: name.to_owned(), device, polled: sent, at_once })?;
        all.remove(name);
        all.insert(polled.name.clone(), polled);
        Ok(())
    }

    /// A link for listeners. It is the link of all devices at this address too, and the first that
    /// asks for it decides its settings.
    ///
    /// # Errors
    /// [`PollerError::Stopped`].
    pub fn link(&self, settings: LinkSettings) -> Result<Arc<SharedLink>, PollerError> {
        let address = address(&settings.endpoint);
        let mut all = lock(&self.shared);
        let known = all.iter().find(|(other, _)| *other == address);
        if let Some(known) = known.and_then(|(_, link)| link.upgrade()) {
            return Ok(known);
        }
        let (calls, called) = mpsc::unbounded_channel();
        let link = Arc::new(SharedLink::new(&settings, calls));
        self.send(Command::Serve(Box::new(settings), Arc::downgrade(&link), called))?;
        all.retain(|(_, link)| link.strong_count() > 0);
        all.push((address, Arc::downgrade(&link)));
        Ok(link)
    }

    /// The link to an address that a device or another user of a link already has; `None` if there is
    /// none. If only devices have it, creates the link, with default settings.
    ///
    /// # Errors
    /// [`PollerError::Stopped`].
    pub fn link_if_used(&self, endpoint: Endpoint) -> Result<Option<Arc<SharedLink>>, PollerError> {
        let mut settings = LinkSettings::new(endpoint);
        let address = address(&settings.endpoint);
        let polled = lock(&self.polled);
        let polled = polled.values().filter(|device| *device.address == address);
        let is_known = if let Some(polled) = polled.min_by_key(|device| device.number) {
            settings.endpoint.tolerance = polled.tolerance;
            true
        } else {
            let all = lock(&self.shared);
            all.iter().any(|(other, link)| *other == address && link.strong_count() > 0)
        };
        is_known.then(|| self.link(settings)).transpose()
    }

    /// Forgets the links that no device and none of `used` has: the next user of such an address gets a new
    /// one, with its own settings.
    ///
    /// # Errors
    /// [`PollerError::Stopped`].
    pub fn forget_links(&self, used: &[Arc<SharedLink>]) -> Result<(), PollerError> {
        let polled = lock(&self.polled);
        let polled: HashSet<_> = polled.values().map(|device| &*device.address).collect();
        let mut all = lock(&self.shared);
        for (address, _) in all.extract_if(.., |(address, link)| {
            let is_used = used.iter().any(|used| ptr::eq(Arc::as_ptr(used), link.as_ptr()));
            !is_used && !polled.contains(address)
        }) {
            self.send(Command::Forget(address))?;
        }
        Ok(())
    }

    /// Passes writes into ranges of a memory on to the devices that they are read from.
    ///
    /// # Errors
    /// [`PollerError::Beyond`] for a range that the memory or the device does not have.
    pub fn passage(
        &self,
        memory: Arc<Memory>,
        ranges: Vec<PassedRange>,
    ) -> Result<Passage, PollerError> {
        for (read, range) in ranges.iter().enumerate() {
            let inside = memory.span(range.area).holds(range.address, range.count as usize);
            if !inside || u32::from(range.device_address) + range.count > 65_536 {
                return Err(PollerError::Beyond { device: range.device.to_string(), read });
            }
        }
        Ok(Passage::new(memory, ranges, self.passed.clone()))
    }

    /// Sends a write over the connection of a device. Returns a number, under which its result is
    /// passed `to` a receiver. It fails with [`Fault::Expired`] if it was not sent by `until` plus one timeout of the
    /// device, if the thread stood still while it waited, or if the receiver has withdrawn it.
    ///
    /// # Errors
    /// [`PollerError`] if there is no such device, or the request is not a write.
    pub fn write(
        &self,
        name: &str,
        request: Box<EncodedRequest>,
        until: Option<Instant>,
        to: &Arc<Results>,
    ) -> Result<u64, PollerError> {
        if !request.request().is_some_and(|request| request.function().is_write()) {
            let function = request.pdu()[0];
            return Err(PollerError::NoWrite { device: name.to_owned(), function });
        }
        if !lock(&self.polled).contains_key(name) {
            return Err(PollerError::Unknown { device: name.to_owned() });
        }
        let ticket = self.tickets.fetch_add(1, Ordering::Relaxed);
        let (device, queued, to) = (name.to_owned(), suspend_aware_time(), Arc::clone(to));
        self.send(Command::Write { device, ticket, request, queued, until, to })?;
        Ok(ticket)
    }

    /// Stops polling a device. Its connection is closed when no other device uses it. Writes that were not
    /// sent end with [`Fault::Withdrawn`]. Returns whether there was a device of that name.
    pub fn remove(&self, name: &str) -> bool {
        let mut all = lock(&self.polled);
        let known = all.remove(name).is_some();
        if known {
            // A stopped poller polls nothing.
            let _ = self.send(Command::Remove(name.to_owned()));
        }
        known
    }

    /// The current devices, in the order in which they were added.
    pub fn devices(&self) -> Vec<Polled> {
        let mut devices: Vec<_> = lock(&self.polled).values().cloned().collect();
        devices.sort_unstable_by_key(|device| device.number);
        devices
    }

    /// A new receiver of polls and of the results of writes. It ends with the poller.
    pub fn receiver(&self) -> Arc<Results> {
        self.receivers.add()
    }

    /// Stops polling. Complete reads have been passed on. A read in progress is abandoned.
    pub fn stop(&self) {
        if self.thread.are_of_another_process() {
            return;
        }
        // The poller may already be stopped.
        let _ = self.send(Command::Stop);
        self.thread.join();
    }
}

impl Drop for Poller {
    fn drop(&mut self) {
        self.stop();
    }
}
/// Commands are sent under the lock of the list of devices, so they arrive in the order of its
/// changes.
const SAME_AS_LIST: &str = "the running devices are those in the list";

/// Starts and stops the tasks of devices, until [`Command::Stop`].
async fn run_commands(
    mut commands: mpsc::UnboundedReceiver<Command>,
    mut passed: mpsc::UnboundedReceiver<PassedWrite>,
) {
    let mut links = Links::default();
    let mut running: HashMap<String, RunningDevice> = HashMap::new();
    let mut fences = Fences::default();
    let mut started = 0;
    spawn_local(standstill::watch());
    loop {
        let command = tokio::select! {
            biased;
            command = commands.recv() => command,
            Some(write) = passed.recv() => {
                match running.get(write.device()) {
                    Some(device) => device.pass(write),
                    None => write.refuse(),
                }
                continue;
            }
        };
        let Some(command) = command else { return };
        match command {
            Command::Stop => return,
            Command::Serve(settings, shared, calls) => {
                let link = links.to(&settings.endpoint, (settings.in_flight, settings.retry));
                // It is in use until nobody can call it any more.
                spawn_local(async move {
                    serve(Rc::clone(&link.0), *settings, shared, calls).await;
                    link.leave();
                });
            }
            Command::Forget(address) => {
                links.forget(&address);
            }
            Command::Remove(name) => {
                let removed = running.remove(&name);
                debug_assert!(removed.is_some(), "{SAME_AS_LIST}");
                if let Some(removed) = removed {
                    let left = Rc::clone(&removed.link);
                    drop(removed);
                    links.device_left(left);
                }
            }
            Command::Add(planned, polled) => {
                let phase = schedule::first_poll(planned.settings.start_within, started);
                started += 1;
                fences.watch(planned.settings.fence.as_ref());
                let name = planned.settings.name.clone();
                let DeviceSettings { endpoint, in_flight, retry, .. } = &planned.settings;
                let link = links.to(endpoint, (*in_flight, *retry));
                let device = RunningDevice::start(*planned, polled, link, phase);
                let before = running.insert(name, device);
                debug_assert!(before.is_none(), "{SAME_AS_LIST}");
            }
            Command::Replace { name, device: planned, polled, at_once } => {
                let DeviceSettings { endpoint, in_flight, retry, .. } = &planned.settings;
                let link = links.to(endpoint, (*in_flight, *retry));
                let before = running.remove(&name);
                debug_assert!(before.is_some(), "{SAME_AS_LIST}");
                let left = before.as_ref().map(|before| Rc::clone(&before.link));
                fences.watch(planned.settings.fence.as_ref());
                let name = planned.settings.name.clone();
                let device = match before {
                    Some(mut device) if !device.has_panicked() => {
                        device.replace(*planned, polled, link, at_once);
                        device
                    }
                    // A panicked task cannot hand over to a new device.
                    ended => {
                        drop(ended);
                        RunningDevice::start(*planned, polled, link, Duration::ZERO)
                    }
                };
                running.insert(name, device);
                if let Some(left) = left {
                    links.device_left(left);
                }
            }
            Command::Write { device, ticket, request, queued, until, to } => {
                match running.get(&device) {
                    Some(device) => device.write(ticket, request, (queued, until), to),
                    None => to.push_write(Written { ticket, outcome: Err(Fault::Withdrawn) }),
                }
            }
        }
    }
}
/// The fences of devices, each with a task that notices when its end has passed.
#[derive(Default)]
struct Fences(HashMap<*const Fence, Weak<Fence>>);

impl Fences {
    fn watch(&mut self, fence: Option<&Arc<Fence>>) {
        let Some(fence) = fence else { return };
        if !self.0.contains_key(&Arc::as_ptr(fence)) {
            self.0.retain(|_, other| other.strong_count() > 0);
            self.0.insert(Arc::as_ptr(fence), Arc::downgrade(fence));
            spawn_local(Fence::watch(Arc::downgrade(fence)));
        }
    }
}

#[cfg(test)]
mod tests;
