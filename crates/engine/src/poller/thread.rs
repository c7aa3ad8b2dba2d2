//! Runs all devices on one thread. Devices can be added and removed, and are stopped together.

use std::cell::RefCell;
use std::collections::{HashMap, HashSet};
use std::future;
use std::io;
use std::net::IpAddr;
use std::ptr;
use std::rc::{self, Rc};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, Weak};
use std::thread;
use std::time::{Duration, Instant};

use holdfast_memory::Memory;
use holdfast_protocol::client::Tolerance;
use holdfast_protocol::pdu::{EncodedRequest, ExceptionCode, limit};
use holdfast_runtime::{Retry, lock, time_since_boot};
use thiserror::Error;
use tokio::runtime::Builder;
use tokio::sync::{mpsc, watch};
use tokio::task::{AbortHandle, LocalSet, spawn_local};

use super::destination::{ReadSettings, mirrors};
use super::device::{Device, DeviceSettings, Inbox, Planned};
use super::forwarding::{Forward, ForwardCounters, ForwardSettings};
use super::panic_guard::spawn_guarded;
use super::plan::{PlanError, PlanLimits};
use super::results::{Receivers, Results, Written};
use super::schedule;
use super::state::DeviceState;
use super::turn::Turn;
use super::write_through::{Passage, PassedRange, PassedWrite};
use crate::client::{Endpoint, Place};
use crate::heartbeat::Heartbeat;
use crate::link::{
    Call, Fault, Fence, InFlight, Link, LinkSettings, Permit, Priority, SharedLink, Stage, Wanted,
    fault, serve, standstill,
};
use crate::own_threads::OwnThreads;
use crate::tls::client::Identity;

#[derive(Debug, Error)]
pub enum PollerError {
    #[error("device {device}: {error}")]
    Plan { device: String, error: PlanError },
    #[error("device {device}: read {read} does not fit into its destination")]
    Destination { device: String, read: usize },
    #[error("device {device}: the status block does not fit into its memory")]
    Status { device: String },
    #[error("device {device}: read {read} has no items, or goes beyond address 65535")]
    Beyond { device: String, read: usize },
    #[error("device {device}: read {read} has 65536 items, a forwarded packet has at most 65535")]
    Forward { device: String, read: usize },
    #[error("device {device}: forward {forward} moves read {read} beyond address 65535")]
    Offset { device: String, forward: usize, read: usize },
    #[error("device {device}: the status block of forward {forward} ends beyond address 65535")]
    ForwardedStatus { device: String, forward: usize },
    #[error("device {device}: max_{items} is {found}, allowed: 1 to {most}")]
    Limit { device: String, items: &'static str, found: u16, most: u16 },
    #[error("device {device}: the name is already in use")]
    Taken { device: String },
    #[error("device {device}: there is no device of that name")]
    Unknown { device: String },
    #[error("device {device}: function {function} does not write")]
    NoWrite { device: String, function: u8 },
    #[error("the poller has been stopped")]
    Stopped,
    #[error("can't start the poller's thread: {0}")]
    Thread(io::Error),
}

/// A polled device, as seen from outside.
#[derive(Clone)]
pub struct Polled {
    pub name: String,
    /// Grows in the order in which devices are added.
    number: u64,
    pub state: Arc<DeviceState>,
    pub forwards: Vec<Arc<ForwardCounters>>,
    /// The queue that receives its polls.
    pub report: Option<Arc<Results>>,
    /// The settings of `forwards`.
    receivers: Arc<[ForwardSettings]>,
    address: Arc<Address>,
    /// What the device needs. At one address, what the first device needs counts.
    tolerance: Tolerance,
}

impl Polled {
    fn new(device: &DeviceSettings, number: u64, state: Arc<DeviceState>) -> Polled {
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
    fn keep_forwards(&mut self, before: &Polled) {
        let mut known: Vec<_> = before.receivers.iter().zip(&before.forwards).collect();
        for (settings, counters) in self.receivers.iter().zip(&mut self.forwards) {
            if let Some(at) = known.iter().position(|(other, _)| *other == settings) {
                *counters = Arc::clone(known.remove(at).1);
            }
        }
    }
}

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
        /// When it came, by [`time_since_boot`].
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
    /// passed `to` a receiver. What can't be sent until a time, and one timeout of the device, or waits
    /// through a standstill, fails with [`Fault::Expired`].
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
        let (device, queued, to) = (name.to_owned(), time_since_boot(), Arc::clone(to));
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

/// A device as the thread of the poller sees it.
struct Running {
    link: Rc<UsedLink>,
    turn: Rc<Turn>,
    unit_id: u8,
    timeout: Duration,
    release: bool,
    fence: Option<Arc<Fence>>,
    /// What is read from it now. Writes that are under way look here, and see nothing once their device
    /// is gone.
    reads: Rc<RefCell<Vec<ReadSettings>>>,
    /// Writes that were not sent end with it.
    writes: watch::Sender<()>,
    inbox: Rc<Inbox>,
    device: AbortHandle,
    forwards: Vec<RunningForward>,
}

impl Drop for Running {
    fn drop(&mut self) {
        self.reads.take();
        self.device.abort();
    }
}

/// A receiver and the task that sends to it.
struct RunningForward {
    forward: Rc<Forward>,
    task: AbortHandle,
}

impl RunningForward {
    fn start(
        settings: ForwardSettings,
        counters: Arc<ForwardCounters>,
        fence: Option<Arc<Fence>>,
        state: &Arc<DeviceState>,
    ) -> RunningForward {
        let forward = Forward::new(settings, counters, fence);
        let task = spawn_guarded(Rc::clone(&forward).run(), Arc::clone(state));
        RunningForward { forward, task }
    }

    /// Whether it has these counters and this fence, and has not panicked.
    fn goes_on(&self, counters: &Arc<ForwardCounters>, fence: Option<&Arc<Fence>>) -> bool {
        Arc::ptr_eq(&self.forward.counters, counters)
            && self.forward.is_behind(fence)
            && !self.task.is_finished()
    }
}

impl Drop for RunningForward {
    fn drop(&mut self) {
        self.task.abort();
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
    let mut running: HashMap<String, Running> = HashMap::new();
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
                    None => write.refuse(ExceptionCode::GatewayPathUnavailable),
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
                let device = Running::start(*planned, polled, link, phase);
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
                    Some(mut device) if !device.has_ended() => {
                        device.replace(*planned, polled, link, at_once);
                        device
                    }
                    // A panicked task cannot hand over to a new device.
                    ended => {
                        drop(ended);
                        Running::start(*planned, polled, link, Duration::ZERO)
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

impl Running {
    /// Starts the tasks of a device.
    fn start(planned: Planned, polled: Polled, link: Rc<UsedLink>, phase: Duration) -> Running {
        let inbox = Rc::new(Inbox::default());
        let DeviceSettings { unit_id, timeout, release, .. } = planned.settings;
        let fence = planned.settings.fence.clone();
        let reads = Rc::new(RefCell::new(planned.settings.reads.clone()));
        let turn = Rc::new(Turn::default());
        let to = (Rc::clone(&link.0), Rc::clone(&turn));
        let state = Arc::clone(&polled.state);
        let (device, forwards) = made(planned, polled, to, Vec::new());
        let device = spawn_guarded(device.run(phase, Rc::clone(&inbox)), state);
        let writes = watch::Sender::default();
        Running {
            link,
            turn,
            unit_id,
            timeout,
            release,
            fence,
            reads,
            writes,
            inbox,
            device,
            forwards,
        }
    }

    /// Whether the task of the device has panicked. It does not end otherwise.
    fn has_ended(&self) -> bool {
        self.device.is_finished()
    }

    fn replace(&mut self, planned: Planned, polled: Polled, link: Rc<UsedLink>, at_once: bool) {
        let settings = &planned.settings;
        let is_other = !Rc::ptr_eq(&self.link, &link) || self.unit_id != settings.unit_id;
        if is_other || mirrors(&self.reads.borrow()).ne(mirrors(&settings.reads)) {
            // Packets say where values go, and not where they were read.
            self.forwards.iter().for_each(|running| running.forward.withdraw());
        }
        if is_other {
            // Another device: writes that are under way are not its own.
            self.reads.take();
            self.reads = Rc::default();
            self.writes = watch::Sender::default();
        }
        self.reads.borrow_mut().clone_from(&settings.reads);
        (self.unit_id, self.timeout) = (settings.unit_id, settings.timeout);
        (self.release, self.link) = (settings.release, link);
        self.fence.clone_from(&settings.fence);
        let before = std::mem::take(&mut self.forwards);
        let to = (Rc::clone(&self.link.0), Rc::clone(&self.turn));
        let (device, forwards) = made(planned, polled, to, before);
        self.forwards = forwards;
        if at_once {
            device.want_soon();
        }
        self.inbox.succeed(device);
    }

    /// Of a write: it is sent only while its device is there.
    fn permit(&self, until: Option<Instant>) -> Permit {
        let device = self.writes.subscribe();
        let wanted: Wanted = Arc::new(move |_| device.has_changed().is_ok());
        Permit { fence: self.fence.clone(), until, wanted: Some(wanted) }
    }

    /// Sends a write between two reads, as soon as possible. One that was sent has its result, even if the
    /// device is removed.
    fn write(
        &self,
        ticket: u64,
        request: Box<EncodedRequest>,
        (queued, until): (Duration, Option<Instant>),
        to: Arc<Results>,
    ) {
        let (link, turn) = (Rc::clone(&self.link.0), Rc::clone(&self.turn));
        let inbox = Rc::clone(&self.inbox);
        let Running { unit_id, timeout, release, .. } = *self;
        let until = until.map(|until| until + timeout);
        // Set once, by the thread of the link or by the end of the device.
        let is_sent = Arc::new(OnceLock::new());
        let mut device = self.writes.subscribe();
        let sent = Arc::clone(&is_sent);
        let permit = self.permit(until).and(standstill::none_since(queued));
        let permit = permit.and(Arc::new(move |is_sent| match is_sent {
            true => *sent.get_or_init(|| true),
            false => true,
        }));
        let withdrawn = async move {
            let _ends = device.changed().await;
            if *is_sent.get_or_init(|| false) {
                future::pending::<()>().await;
            }
        };
        let sending = async move {
            let fence = permit.fence.as_ref();
            let taken = permit.in_time(turn.take_to_write(fence, timeout)).await;
            let taken = taken.ok_or(Fault::Expired)?.ok_or(Fault::Standby)?;
            let answer = link.call(unit_id, &request, timeout, Priority::Urgent, &permit).await;
            drop(taken);
            if release || has_ended(fence) {
                link.release();
            }
            if answer.is_ok() {
                inbox.wake();
            }
            answer.map(drop).map_err(|error| fault(&error))
        };
        spawn_local(async move {
            let outcome = tokio::select! {
                biased;
                () = withdrawn => Err(Fault::Withdrawn),
                outcome = sending => outcome,
            };
            to.push_write(Written { ticket, outcome });
        });
    }

    /// Carries out a write of a Modbus client, between two reads.
    fn pass(&self, write: PassedWrite) {
        let (link, turn) = (Rc::clone(&self.link.0), Rc::clone(&self.turn));
        let (inbox, reads) = (Rc::clone(&self.inbox), Rc::clone(&self.reads));
        let Running { unit_id, timeout, release, .. } = *self;
        let permit = self.permit(None);
        spawn_local(async move {
            let fence = permit.fence.as_ref();
            let Some(taken) = turn.take_to_write(fence, timeout).await else {
                return write.refuse(ExceptionCode::GatewayPathUnavailable);
            };
            let changes = write.carry_out((&link, unit_id, &reads), timeout, &permit).await;
            if !changes.is_empty() {
                inbox.wake();
            }
            changes.into_iter().for_each(|change| turn.note(change));
            drop(taken);
            if release || has_ended(fence) {
                link.release();
            }
        });
    }
}

/// Whether a device stands by, so that a write leaves no connection behind.
fn has_ended(fence: Option<&Arc<Fence>>) -> bool {
    fence.is_some_and(|fence| fence.stage() != Stage::Open)
}

/// Creates a device, and starts the tasks that forward its reads. Those of the device before that have
/// the same receiver and fence go on: they send what is waiting, and what the current poll reads.
fn made(
    planned: Planned,
    polled: Polled,
    to: (Rc<Link>, Rc<Turn>),
    mut before: Vec<RunningForward>,
) -> (Device, Vec<RunningForward>) {
    polled.state.set_broken(false);
    polled.state.set_strays(to.0.strays());
    let settings = &planned.settings;
    debug_assert_eq!(settings.forward.len(), polled.forwards.len());
    let fence = settings.fence.as_ref();
    let receivers = settings.forward.iter().cloned().zip(polled.forwards);
    let running: Vec<RunningForward> = receivers
        .map(|(settings, counters)| {
            match before.iter().position(|old| old.goes_on(&counters, fence)) {
                Some(at) => before.swap_remove(at),
                None => RunningForward::start(settings, counters, fence.cloned(), &polled.state),
            }
        })
        .collect();
    let forwards = running.iter().map(|running| Rc::clone(&running.forward)).collect();
    (Device::new(planned, polled.state, to, forwards), running)
}

/// A link that devices or listeners use. What a removed device has sent may still hold the link itself.
struct UsedLink(Rc<Link>);

impl UsedLink {
    /// One of its users has left. It is closed if no one else uses it.
    fn leave(self: Rc<UsedLink>) {
        if let Some(UsedLink(link)) = Rc::into_inner(self) {
            spawn_local(async move { link.close().await });
        }
    }
}

/// The last link to an address.
struct KnownLink {
    used: rc::Weak<UsedLink>,
    link: rc::Weak<Link>,
    settings: (Endpoint, InFlight, Retry),
}

/// The links to all addresses, each shared by all that ask for it while others use it.
#[derive(Default)]
struct Links {
    by_address: HashMap<Address, KnownLink>,
    /// How often a link has lost a user since those that have ended were removed.
    departures: usize,
}

impl Links {
    fn to(&mut self, endpoint: &Endpoint, (in_flight, retry): (InFlight, Retry)) -> Rc<UsedLink> {
        let settings = (endpoint.clone(), in_flight, retry);
        let address = address(endpoint);
        let known = self.by_address.get(&address);
        if let Some(used) = known.and_then(|known| known.used.upgrade()) {
            return used;
        }
        let ending = known.and_then(|known| Some((known.link.upgrade()?, &known.settings)));
        let link = match ending {
            Some((link, of)) if *of == settings => link,
            ending => {
                let link = Link::new(endpoint.clone(), in_flight, retry);
                ending.into_iter().for_each(|(before, _)| link.follow(before));
                link
            }
        };
        let used = Rc::new(UsedLink(Rc::clone(&link)));
        let (link, in_use) = (Rc::downgrade(&link), Rc::downgrade(&used));
        self.by_address.insert(address, KnownLink { used: in_use, link, settings });
        used
    }

    /// The next user of the address gets a new link, which follows this one.
    fn forget(&mut self, address: &Address) {
        if let Some(known) = self.by_address.get_mut(address) {
            known.used = rc::Weak::new();
        }
        self.departed();
    }

    fn device_left(&mut self, left: Rc<UsedLink>) {
        left.leave();
        self.departed();
    }

    /// Removes links that have ended. This looks at all of them, so it waits until it may find many.
    fn departed(&mut self) {
        self.departures += 1;
        if 2 * self.departures >= self.by_address.len() {
            self.by_address.retain(|_, known| known.link.strong_count() > 0);
            self.departures = 0;
        }
    }
}

/// The key of a shared link: its address, and its TLS identity.
type Address = (String, Option<Arc<Identity>>);

fn address(endpoint: &Endpoint) -> Address {
    let identity = match &endpoint.place {
        Place::Tcp { tls: Some(tls), .. } => Some(Arc::clone(tls.identity())),
        _ => None,
    };
    let (scheme, host, port) = match &endpoint.place {
        // As configured: a link of `/dev/serial` names another device after adapters were plugged in again.
        Place::Serial(line) => return (format!("serial:{}", line.device), None),
        Place::Tcp { host, port, .. } => ("tcp", host, port),
        Place::RtuOverTcp { host, port } => ("rtu+tcp", host, port),
        Place::AsciiOverTcp { host, port } => ("ascii+tcp", host, port),
        Place::Udp { host, port } => ("udp", host, port),
        Place::RtuOverUdp { host, port } => ("rtu+udp", host, port),
    };
    // The same address can be written in several ways.
    let host = match host.parse::<IpAddr>() {
        Ok(address) => address.to_canonical().to_string(),
        Err(_) => host.to_ascii_lowercase(),
    };
    (format!("{scheme}://{host}:{port}"), identity)
}

/// Checks the settings of a device and plans its reads.
fn checked(device: DeviceSettings) -> Result<Planned, PollerError> {
    let name = || device.name.clone();
    let PlanLimits { max_registers, max_bits, .. } = device.limits;
    for (items, found, most) in
        [("registers", max_registers, limit::READ_REGISTERS), ("bits", max_bits, limit::READ_BITS)]
    {
        if !(1..=most).contains(&found) {
            return Err(PollerError::Limit { device: name(), items, found, most });
        }
    }
    for (read, settings) in device.reads.iter().enumerate() {
        if settings.count == 0 || settings.count > 65_536 - u32::from(settings.address) {
            return Err(PollerError::Beyond { device: name(), read });
        }
        let alike = |into: &super::Destination| {
            into.area.is_bits() == settings.area.is_bits() && into.holds(settings.count)
        };
        if !settings.into.as_ref().is_none_or(alike) {
            return Err(PollerError::Destination { device: name(), read });
        }
        if !settings.forward || device.forward.is_empty() {
            continue;
        }
        if settings.count > u32::from(u16::MAX) {
            return Err(PollerError::Forward { device: name(), read });
        }
        let (area, address) = match &settings.into {
            Some(into) => (into.area, into.address),
            None => (settings.area, settings.address),
        };
        let last = u32::from(address) + settings.count - 1;
        let fits = |forward: &ForwardSettings| {
            u16::try_from(last).is_ok_and(|last| forward.address(area, last).is_some())
        };
        if let Some(forward) = device.forward.iter().position(|forward| !fits(forward)) {
            return Err(PollerError::Offset { device: name(), forward, read });
        }
    }
    let is_wrong = |forward: &ForwardSettings| {
        forward.status.as_ref().is_some_and(|(_, block)| !block.is_possible())
    };
    if let Some(forward) = device.forward.iter().position(is_wrong) {
        return Err(PollerError::ForwardedStatus { device: name(), forward });
    }
    if !device.status.as_ref().is_none_or(super::StatusSettings::fits) {
        return Err(PollerError::Status { device: name() });
    }
    let name = name();
    Planned::new(device).map_err(|error| PollerError::Plan { device: name, error })
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU16;
    use std::sync::Arc;

    use holdfast_memory::{Area, Layout, Memory, Span};
    use holdfast_protocol::pdu::{Range, Request};
    use holdfast_protocol::raw_ingest::Format;

    use super::*;
    use crate::poller::{BlockSettings, Destination, ReadSettings, StatusSettings};

    const AREA: Area = Area::HoldingRegisters;

    fn memory() -> Arc<Memory> {
        let layout = Layout::default().with(AREA, Span::new(10, 70).unwrap());
        Arc::new(Memory::new(layout, None).unwrap())
    }

    fn block(area: Area, slot: u16) -> BlockSettings {
        BlockSettings { area, slot, name: "meter".into(), keep_last_error: false }
    }

    fn settings() -> DeviceSettings {
        let endpoint = Place::Tcp { host: "127.0.0.1".into(), port: 502, tls: None }.into();
        let read = ReadSettings { area: AREA, address: 0, count: 4, into: None, forward: true };
        DeviceSettings::for_tests(endpoint, vec![read])
    }

    #[test]
    fn an_address_can_be_written_in_several_ways() {
        let written =
            |host: &str| address(&Place::Tcp { host: host.into(), port: 502, tls: None }.into());
        assert_eq!(written("PLC.local"), written("plc.local"));
        assert_eq!(written("::FFFF:10.0.0.5"), written("10.0.0.5"));
        assert_eq!(written("fd00:0::1"), written("fd00::1"));
        assert_ne!(written("10.0.0.5"), written("10.0.0.50"));
        let other = Place::RtuOverTcp { host: "10.0.0.5".into(), port: 502 }.into();
        assert_ne!(written("10.0.0.5"), address(&other));
    }

    fn refused(change: impl FnOnce(&mut DeviceSettings)) -> String {
        let mut changed = settings();
        change(&mut changed);
        checked(changed).expect_err("the settings are invalid").to_string()
    }

    #[test]
    fn limits_above_those_of_a_request_are_refused() {
        for limit in [0, 126, u16::MAX] {
            let expected = format!("device meter: max_registers is {limit}, allowed: 1 to 125");
            assert_eq!(refused(|device| device.limits.max_registers = limit), expected);
        }
        for limit in [0, 2001] {
            let expected = format!("device meter: max_bits is {limit}, allowed: 1 to 2000");
            assert_eq!(refused(|device| device.limits.max_bits = limit), expected);
        }
    }

    #[test]
    fn reads_beyond_the_last_address_are_refused() {
        for (address, count) in [(0, 0), (1, 65_536), (65_535, 2), (1, u32::MAX)] {
            let expected = "device meter: read 0 has no items, or goes beyond address 65535";
            let beyond = ReadSettings { area: AREA, address, count, into: None, forward: true };
            assert_eq!(refused(|device| device.reads = vec![beyond]), expected);
        }
    }

    #[test]
    fn a_destination_that_is_too_small_is_refused() {
        for (area, address) in
            [(AREA, 9), (AREA, 77), (Area::InputRegisters, 10), (Area::Coils, 10)]
        {
            let into = Some(Destination { memory: memory(), area, address, age: None });
            let expected = "device meter: read 0 does not fit into its destination";
            assert_eq!(refused(|device| device.reads[0].into = into), expected);
        }
        for (area, slot) in [(AREA, 0), (AREA, 2), (AREA, u16::MAX), (Area::Coils, 1)] {
            let status = Some(StatusSettings { memory: memory(), block: block(area, slot) });
            let expected = "device meter: the status block does not fit into its memory";
            assert_eq!(refused(|device| device.status = status), expected);
        }
        let forward = |offset, status: Option<BlockSettings>| ForwardSettings {
            host: "127.0.0.1".into(),
            port: 1,
            tls: None,
            format: Format::V1,
            target: 1,
            timeout: Duration::from_secs(1),
            offsets: vec![(AREA, offset)],
            status: status.map(|block| (2, block)),
        };
        let (near, far) = (forward(65_532, None), forward(65_533, None));
        let expected = "device meter: forward 1 moves read 0 beyond address 65535";
        assert_eq!(refused(|device| device.forward = vec![near.clone(), far]), expected);
        for (area, slot) in [(Area::Coils, 0), (AREA, 2184)] {
            let beyond = forward(0, Some(block(area, slot)));
            let expected = "device meter: the status block of forward 0 ends beyond address 65535";
            assert_eq!(refused(|device| device.forward = vec![beyond]), expected);
        }
        let mut fits = settings();
        fits.forward = vec![near, forward(0, Some(block(AREA, 2183)))];
        assert!(checked(fits).is_ok());
        let mut fits = settings();
        fits.reads[0].into =
            Some(Destination { memory: memory(), area: AREA, address: 76, age: None });
        fits.status = Some(StatusSettings { memory: memory(), block: block(AREA, 1) });
        assert!(checked(fits).is_ok());
    }

    #[test]
    fn devices_have_the_order_in_which_they_were_added_and_a_replacement_the_place_of_the_other() {
        let named = |name: &str| DeviceSettings { name: name.into(), ..settings() };
        let poller = Poller::start(["c", "b", "a"].map(named).into()).unwrap();
        let names = || poller.devices().into_iter().map(|device| device.name).collect::<Vec<_>>();
        assert!(matches!(poller.add(named("b")), Err(PollerError::Taken { .. })));
        assert!(matches!(poller.replace("b", named("a"), false), Err(PollerError::Taken { .. })));
        assert!(matches!(poller.replace("x", named("y"), false), Err(PollerError::Unknown { .. })));
        poller.replace("b", named("d"), false).unwrap();
        poller.replace("a", named("a"), false).unwrap();
        poller.add(named("b")).unwrap();
        assert_eq!(names(), ["c", "d", "a", "b"]);
        assert!(poller.remove("c") && !poller.remove("c"));
        poller.add(named("c")).unwrap();
        assert_eq!(names(), ["d", "a", "b", "c"]);
    }

    fn receiver(target: u16) -> ForwardSettings {
        ForwardSettings { target, ..ForwardSettings::for_tests(1, None) }
    }

    #[test]
    fn receivers_that_stay_keep_their_counters() {
        let with = |targets: &[u16]| {
            let forward = targets.iter().copied().map(receiver).collect();
            DeviceSettings { forward, ..settings() }
        };
        let poller = Poller::start(vec![with(&[1, 2, 2])]).unwrap();
        let counters = || poller.devices().remove(0).forwards;
        let before = counters();
        poller.replace("meter", with(&[2, 3, 2, 2]), false).unwrap();
        let now = counters();
        let kept = now.iter().map(|each| before.iter().position(|other| Arc::ptr_eq(each, other)));
        assert_eq!(kept.collect::<Vec<_>>(), [Some(1), None, Some(2), None]);
    }

    #[test]
    fn a_receiver_that_stays_gets_what_is_waiting_for_it_and_one_that_goes_ends() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let with = |targets: [u16; 2]| {
                let device = DeviceSettings { forward: targets.map(receiver).into(), ..settings() };
                checked(device).unwrap()
            };
            let mut links = Links::default();
            let mut link =
                || links.to(&settings().endpoint, (InFlight::Fixed(1), Retry::default()));
            let (first, second) = (with([1, 2]), with([2, 3]));
            let before = Polled::new(&first.settings, 0, Arc::default());
            let mut polled = Polled::new(&second.settings, 0, Arc::clone(&before.state));
            polled.keep_forwards(&before);
            let hour = Duration::from_secs(3600);
            let mut running = Running::start(first, before, link(), hour);
            let forward = |running: &Running, at: usize| Rc::clone(&running.forwards[at].forward);
            let (goes, stays) = (forward(&running, 0), forward(&running, 1));
            let ended = running.forwards[0].task.clone();
            running.replace(second, polled, link(), false);
            assert!(Rc::ptr_eq(&forward(&running, 0), &stays));
            assert!(!Rc::ptr_eq(&forward(&running, 1), &goes));
            while !ended.is_finished() {
                tokio::task::yield_now().await;
            }
            assert!(!running.forwards[0].task.is_finished());
        });
    }

    #[test]
    fn a_receiver_gets_nothing_that_was_read_elsewhere_before_a_reload() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let into = Destination { memory: memory(), area: AREA, address: 10, age: None };
            let with = |address, unit_id| {
                let mut device = DeviceSettings { unit_id, ..settings() };
                device.reads[0] =
                    ReadSettings { address, into: Some(into.clone()), ..device.reads[0].clone() };
                device.forward = vec![receiver(1)];
                checked(device).unwrap()
            };
            let mut links = Links::default();
            let mut link =
                || links.to(&settings().endpoint, (InFlight::Fixed(1), Retry::default()));
            let (first, hour) = (with(0, 1), Duration::from_secs(3600));
            let mut polled = Polled::new(&first.settings, 0, Arc::default());
            let mut running = Running::start(first, polled.clone(), link(), hour);
            let forward = Rc::clone(&running.forwards[0].forward);
            for (address, unit_id, goes_on) in [(0, 1, true), (5, 1, false), (5, 2, false)] {
                forward.offer(AREA, 10, NonZeroU16::MIN, &[0, 7]);
                let next = with(address, unit_id);
                let before = polled;
                polled = Polled::new(&next.settings, 0, Arc::clone(&before.state));
                polled.keep_forwards(&before);
                running.replace(next, polled.clone(), link(), false);
                assert!(Rc::ptr_eq(&running.forwards[0].forward, &forward));
                assert_eq!(forward.has_waiting(), goes_on, "{address} {unit_id}");
            }
        });
    }

    #[test]
    fn a_request_that_does_not_write_is_refused() {
        let poller = Poller::start(Vec::new()).unwrap();
        let read = Request::ReadHoldingRegisters(Range::new(0, 1).unwrap());
        let error = poller
            .write("meter", Box::new(EncodedRequest::new(&read)), None, &poller.receiver())
            .unwrap_err();
        assert_eq!(error.to_string(), "device meter: function 3 does not write");
    }
}
