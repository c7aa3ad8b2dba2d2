//! Runs listeners on worker threads. Either all listeners start or none.

use std::io;
use std::mem;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, OnceLock};
use std::thread;
use std::time::Duration;

use holdfast_protocol::pdu::identification::ObjectError;
use holdfast_runtime::{OwnThreads, lock};
use thiserror::Error;
use tokio::runtime::{Builder, Handle, Runtime};
use tokio::sync::watch;
use tokio::task::AbortHandle;

pub use self::listening_sockets::SocketKind;
use self::listening_sockets::{ListeningSocket, tcp, udp as udp_socket};
use crate::heartbeat::Heartbeat;
use crate::serial_line::SerialLine;
use crate::server::connections::admission::{ConnectionLimits, OpenConnection};
use crate::server::connections::listener::{ListenerContext, Service, accept};
use crate::server::connections::reloadable::Reloadable;
use crate::server::reports::audit::{Auditor, Record, Records, Unrecordable, auditing};
use crate::server::reports::counters::{ConnectionCounters, PacketCounters};
use crate::server::reports::event::{
    Event, Events, Kind, Reporter, Verbosity, channel as event_channel,
};
use crate::server::requests::identity::Identity;
use crate::server::requests::unit_server::{UnitServer, UnitSettings};
use crate::server::rights::peer_rights::PeerRights;
use crate::server::rights::policy::Policy;
use crate::server::transports::raw_ingest::{RawIngest, RawSettings};
use crate::server::transports::serial::{ModbusSerial, SerialSettings};
use crate::server::transports::tcp::{ModbusStream, StreamSettings};
use crate::server::transports::udp::{DatagramFraming, ModbusUdp, UdpSettings};

mod listening_sockets;

/// The time that connections have to end when the engine stops.
const STOP_TIMEOUT: Duration = Duration::from_millis(500);

/// Settings of an engine.
#[derive(Debug, Clone)]
pub struct Settings {
    pub listening: Listening,
    /// The number of threads that serve connections, at least 1.
    pub workers: usize,
    pub events: Verbosity,
    /// Whether writes are recorded for an audit log, and what happens to those that can't be.
    pub audit: Option<Unrecordable>,
}

#[derive(Debug, Clone)]
pub struct ListenerSettings {
    pub name: String,
    pub kind: ListenerKind,
}

#[derive(Debug, Clone)]
pub enum ListenerKind {
    ModbusStream(StreamSettings),
    ModbusUdp(UdpSettings),
    ModbusSerial(SerialSettings),
    RawIngest(RawSettings),
}

#[derive(Debug, Error)]
pub enum StartError {
    #[error("listener {listener}: can't listen on {address}: {error}")]
    Bind { listener: String, address: SocketAddr, error: io::Error },
    #[error("listener {listener}: can't open {device}: {error}")]
    Open { listener: String, device: String, error: io::Error },
    #[error("identity: {0}")]
    Identity(#[from] ObjectError),
    #[error("can't start a worker thread: {0}")]
    Worker(io::Error),
}

/// Running listeners, until the engine is stopped or dropped.
pub struct Engine {
    /// In the order of the settings. Locked during a reload.
    listeners: Mutex<Vec<Arc<Listener>>>,
    handles: Vec<Handle>,
    stop: Arc<watch::Sender<bool>>,
    workers: OwnThreads,
    /// One for each worker.
    heartbeats: Vec<Arc<Heartbeat>>,
    reporter: Reporter,
    auditor: Option<Auditor>,
    events: Events,
    records: Option<Records>,
}

/// What a listener serves, and who may use it.
#[derive(Debug, Clone)]
pub struct Listening {
    pub listeners: Vec<ListenerSettings>,
    /// Identification objects by id (function 43/14); 0x00 to 0x02 are mandatory.
    pub identity: Vec<(u8, Vec<u8>)>,
    /// Names of single units, by unit id.
    pub unit_names: Vec<(u8, Vec<u8>)>,
}

/// A running listener.
struct Listener {
    context: Arc<ListenerContext>,
    /// The address in the settings; with port 0 for one that the system picked.
    bind: Option<SocketAddr>,
    /// `None` on a serial line.
    socket: Option<Arc<ListeningSocket>>,
    served: Served,
    task: OnceLock<AbortHandle>,
}

enum Served {
    Stream(Arc<Reloadable<ModbusStream>>, Arc<UnitServer>),
    Datagrams(DatagramFraming, Arc<Reloadable<Policy>>, Arc<UnitServer>),
    Serial(SerialLine, Arc<Reloadable<PeerRights>>, Arc<UnitServer>),
    Packets(Arc<Reloadable<RawIngest>>),
}

/// The counters of a listener.
pub struct ListenerCounters {
    context: Arc<ListenerContext>,
    pub open_connections: usize,
    pub protocol: ProtocolCounters,
}

pub enum ProtocolCounters {
    /// With those of packets on the same port.
    Modbus(Arc<UnitServer>, Option<Arc<PacketCounters>>),
    Packets(Arc<PacketCounters>),
}

impl ListenerCounters {
    pub fn name(&self) -> &str {
        &self.context.name
    }

    pub fn connections(&self) -> &ConnectionCounters {
        &self.context.connections
    }
}

/// The task of a listener. All tasks are started after all listeners are bound.
type Task = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Gives a running listener new settings.
type Update = Box<dyn FnOnce(&Listener) + Send>;

/// A change of a running listener, which can't fail any more.
enum Change {
    Keep(Arc<Listener>, Update),
    Start(Arc<Listener>, Task),
}

impl Engine {
    /// Binds every listener, then starts to serve. If one cannot be bound, none is served.
    ///
    /// # Errors
    /// [`StartError`]. Nothing is left running then.
    pub fn start(settings: Settings) -> Result<Engine, StartError> {
        let (reporter, events) = event_channel(settings.events);
        let (auditor, records) = settings.audit.map(auditing).unzip();
        let (stop, stopping) = watch::channel(false);
        let runtimes: Vec<Runtime> = (0..settings.workers.max(1))
            .map(|_| Builder::new_current_thread().enable_io().enable_time().build())
            .collect::<Result<_, _>>()
            .map_err(StartError::Worker)?;
        let engine = Engine {
            listeners: Mutex::default(),
            handles: runtimes.iter().map(|runtime| runtime.handle().clone()).collect(),
            stop: Arc::new(stop),
            workers: OwnThreads::default(),
            heartbeats: (0..runtimes.len()).map(heartbeat).collect(),
            reporter,
            auditor,
            events,
            records,
        };
        engine.reload(settings.listening)?;
        for (runtime, heartbeat) in runtimes.into_iter().zip(&engine.heartbeats) {
            engine.work(runtime, Arc::clone(heartbeat), stopping.clone())?;
        }
        Ok(engine)
    }

    /// Serves these listeners from now on. A listener with the name, protocol and address of a
    /// running one takes over its socket, its counters and its connections: those that have no
    /// rights any more are ended, the others get their new rights before their next request. Other
    /// running listeners are ended. A new listener takes over the socket of one that ends and has
    /// exactly its address.
    ///
    /// # Errors
    /// [`StartError`]. Nothing has changed then.
    pub fn reload(&self, listening: Listening) -> Result<(), StartError> {
        let Listening { listeners: settings, identity, unit_names } = listening;
        let identity = || Identity::new(&identity, &unit_names);
        identity()?;
        let mut listeners = lock(&self.listeners);
        let mut ending = listeners.clone();
        let kept = |ListenerSettings { name, kind }: &ListenerSettings| {
            let at = ending.iter().position(|running| *running.context.name == **name)?;
            let update = ending[at].update(kind, identity().ok()?)?;
            Some(Change::Keep(ending.remove(at), update))
        };
        let kept: Vec<_> = settings.iter().map(kept).collect();
        let mut sockets = ending.iter().filter_map(|listener| listener.socket.clone()).collect();
        let mut changes = Vec::new();
        for (ListenerSettings { name, kind }, kept) in settings.into_iter().zip(kept) {
            changes.push(match kept {
                Some(kept) => kept,
                None => {
                    let (listener, task) = self
                        .listener(&name, kind, identity()?, &mut sockets)
                        .inspect_err(|_| self.set_modes_again(&listeners))?;
                    Change::Start(Arc::new(listener), task)
                }
            });
        }
        let before = mem::take(&mut *listeners);
        for change in changes {
            listeners.push(match change {
                Change::Keep(listener, update) => {
                    update(&listener);
                    listener
                }
                Change::Start(listener, task) => {
                    let task = self.handles[0].spawn(task);
                    let _ = listener.task.set(task.abort_handle());
                    listener
                }
            });
        }
        for listener in before {
            if !listeners.iter().any(|kept| Arc::ptr_eq(kept, &listener)) {
                listener.end();
            }
        }
        Ok(())
    }

    /// Gives serial lines the modes of the listeners that run: one that opened a line beside them before the
    /// reload failed has set its own.
    fn set_modes_again(&self, listeners: &[Arc<Listener>]) {
        let _runtime = self.handles[0].enter();
        for listener in listeners {
            if let Served::Serial(line, ..) = &listener.served {
                // A line that is lost gets its mode when it is back.
                let _ = line.open();
            }
        }
    }

    /// Binds a listener, or takes over the socket of an ending one. Nothing is served before its task
    /// runs.
    fn listener(
        &self,
        name: &str,
        kind: ListenerKind,
        identity: Identity,
        ending: &mut Vec<Arc<ListeningSocket>>,
    ) -> Result<(Listener, Task), StartError> {
        let _runtime = self.handles[0].enter();
        let bind_error =
            |address| move |error| StartError::Bind { listener: name.to_owned(), address, error };
        let context = |limits: Option<ConnectionLimits>| {
            let (reporter, auditor) = (self.reporter.clone(), self.auditor.clone());
            Arc::new(ListenerContext::new(name, limits, reporter, auditor))
        };
        let unit_server = |settings| Arc::new(UnitServer::new(identity, settings));
        let (workers, stopping) = (self.handles.clone(), self.stop.subscribe());
        let (context, bound, served, task): (_, _, _, Task) = match kind {
            ListenerKind::ModbusStream(stream) => {
                let (accepting, socket) =
                    tcp(stream.bind, ending).map_err(bind_error(stream.bind))?;
                let context = context(Some(stream.limits));
                let unit_server = unit_server(stream.units);
                let service = ModbusStream::new(&stream, Arc::clone(&unit_server), None);
                let live = Arc::new(Reloadable::new(service));
                let served = Served::Stream(Arc::clone(&live), unit_server);
                let task = accept(Arc::clone(&context), live, accepting, workers, stopping);
                (context, Some((stream.bind, socket)), served, Box::pin(task))
            }
            ListenerKind::RawIngest(raw) => {
                let (accepting, socket) = tcp(raw.bind, ending).map_err(bind_error(raw.bind))?;
                let context = context(Some(raw.limits));
                let live = Arc::new(Reloadable::new(RawIngest::new(&raw, Arc::default())));
                let served = Served::Packets(Arc::clone(&live));
                let task = accept(Arc::clone(&context), live, accepting, workers, stopping);
                (context, Some((raw.bind, socket)), served, Box::pin(task))
            }
            ListenerKind::ModbusUdp(udp) => {
                let (datagrams, socket) =
                    udp_socket(udp.bind, ending).map_err(bind_error(udp.bind))?;
                let (context, unit_server) = (context(None), unit_server(udp.units));
                let policy = Arc::new(Reloadable::new(Policy::of(&udp.rules)));
                let (rules, units) = (Arc::clone(&policy), Arc::clone(&unit_server));
                let service = ModbusUdp::new(udp.framing, rules, units);
                let served = Served::Datagrams(udp.framing, policy, unit_server);
                let task = service.serve(Arc::clone(&context), datagrams, stopping);
                (context, Some((udp.bind, socket)), served, Box::pin(task))
            }
            ListenerKind::ModbusSerial(SerialSettings { line, rule, units }) => {
                let port = line.open().map_err(|error| StartError::Open {
                    listener: name.to_owned(),
                    device: line.device.clone(),
                    error,
                })?;
                let (context, unit_server) = (context(None), unit_server(units));
                let rights = Arc::new(Reloadable::new(PeerRights::new(&rule)));
                let (own, units) = (Arc::clone(&rights), Arc::clone(&unit_server));
                let service = ModbusSerial::new(line.clone(), own, units);
                let served = Served::Serial(line, rights, unit_server);
                let task = service.serve(Arc::clone(&context), port, stopping);
                (context, None, served, Box::pin(task))
            }
        };
        let (bind, socket) = bound.map(|(bind, socket)| (bind, Arc::new(socket))).unzip();
        let listener = Listener { context, bind, socket, served, task: OnceLock::new() };
        Ok((listener, task))
    }

    /// Judges all open connections again: a certificate may have expired.
    pub fn review(&self) {
        for listener in lock(&self.listeners).iter() {
            match &listener.served {
                Served::Stream(live, _) => listener.review(live),
                Served::Packets(live) => listener.review(live),
                Served::Datagrams(..) | Served::Serial(..) => {}
            }
        }
    }

    /// The open connections of each listener, by its name.
    pub fn open_connections(&self) -> Vec<(Arc<str>, Vec<OpenConnection>)> {
        let listeners = lock(&self.listeners);
        let of = |listener: &Arc<Listener>| {
            (Arc::clone(&listener.context.name), listener.context.admission.open_connections())
        };
        listeners.iter().map(of).collect()
    }

    /// Ends a connection. Returns whether there was one.
    pub fn end_connection(&self, listener: &str, id: u64) -> bool {
        let listeners = lock(&self.listeners);
        let found = listeners.iter().find(|running| *running.context.name == *listener);
        let ended = found.and_then(|running| {
            running.context.admission.end(id).map(|peer| (Arc::clone(running), peer))
        });
        drop(listeners);
        let Some((running, peer)) = ended else { return false };
        running.context.ended(Kind::Ended, peer);
        true
    }

    /// Runs one worker until the engine stops and its connections have ended.
    fn work(
        &self,
        runtime: Runtime,
        heartbeat: Arc<Heartbeat>,
        mut stopping: watch::Receiver<bool>,
    ) -> Result<(), StartError> {
        let stop = Arc::clone(&self.stop);
        let name = heartbeat.thread().to_owned();
        let body = move || {
            runtime.block_on(heartbeat.during(async move {
                let _ = stopping.wait_for(|stop| *stop).await;
                drop(stopping);
                // Each connection and listener holds a receiver.
                let _ = tokio::time::timeout(STOP_TIMEOUT, stop.closed()).await;
            }));
        };
        let thread = thread::Builder::new().name(name).spawn(body).map_err(StartError::Worker)?;
        self.workers.push(thread);
        Ok(())
    }

    /// The heartbeat of each worker.
    pub fn heartbeats(&self) -> &[Arc<Heartbeat>] {
        &self.heartbeats
    }

    /// The address of each listener, in the order of the settings; `None` for serial lines.
    pub fn addresses(&self) -> Vec<Option<SocketAddr>> {
        lock(&self.listeners)
            .iter()
            .map(|listener| Some(listener.socket.as_ref()?.address))
            .collect()
    }

    /// The sockets that listen. None after `stop`, and in a forked child.
    pub fn sockets(&self) -> Vec<(SocketKind, SocketAddr)> {
        if self.workers.are_of_another_process() || !self.workers.are_running() {
            return Vec::new();
        }
        let listeners = lock(&self.listeners);
        let sockets = listeners.iter().filter_map(|each| each.socket.as_ref());
        sockets.map(|socket| (socket.kind, socket.address)).collect()
    }

    /// The counters of each listener, in the order of the settings.
    pub fn counters(&self) -> Vec<ListenerCounters> {
        lock(&self.listeners).iter().map(|listener| listener.counters()).collect()
    }

    /// Changes which events are sent.
    pub fn set_verbosity(&self, verbosity: Verbosity) {
        self.reporter.set_verbosity(verbosity);
    }

    /// Takes about `most` writes for the audit log. Waits up to `timeout` for the first.
    pub fn next_writes(&self, timeout: Duration, most: usize) -> Vec<Record> {
        self.records.as_ref().map_or_else(Vec::new, |records| records.take(timeout, most))
    }

    /// Whether the audit log can't be written, so that writes which must be recorded are refused.
    /// Ends a wait for writes.
    pub fn set_audit_failing(&self, failing: bool) {
        if let Some(records) = &self.records {
            records.set_failing(failing);
        }
    }

    /// The number of writes that were dropped because the audit queue was full.
    pub fn lost_writes(&self) -> u64 {
        self.records.as_ref().map_or(0, Records::lost)
    }

    /// The number of refused writes that are neither among the writes for the audit log nor counted there.
    pub fn other_refused_writes(&self) -> u64 {
        self.records.as_ref().map_or(0, Records::other_refused)
    }

    /// The next event, if one arrives within `timeout`.
    pub fn next_event(&self, timeout: Duration) -> Option<Event> {
        self.events.next(timeout)
    }

    /// The number of events that were dropped because the queue was full.
    pub fn lost_events(&self) -> u64 {
        self.events.lost()
    }

    /// Stops listening, answers what has been received, and closes every connection. Returns within
    /// a second. A second call waits for the first. Ends a wait for writes. Does nothing in a forked
    /// child.
    pub fn stop(&self) {
        if self.workers.are_of_another_process() {
            return;
        }
        let _ = self.stop.send(true);
        self.workers.join();
        if let Some(records) = &self.records {
            records.wake();
        }
    }
}

/// The heartbeat of the worker with this number.
fn heartbeat(index: usize) -> Arc<Heartbeat> {
    Arc::new(Heartbeat::new(format!("holdfast-io-{index}")))
}

impl Listener {
    fn counters(&self) -> ListenerCounters {
        let protocol = match &self.served {
            Served::Stream(live, unit_server) => {
                ProtocolCounters::Modbus(Arc::clone(unit_server), live.get().packets())
            }
            Served::Datagrams(_, _, unit_server) | Served::Serial(_, _, unit_server) => {
                ProtocolCounters::Modbus(Arc::clone(unit_server), None)
            }
            Served::Packets(live) => ProtocolCounters::Packets(Arc::clone(&live.get().packets)),
        };
        let (context, open_connections) =
            (Arc::clone(&self.context), self.context.admission.open());
        ListenerCounters { context, open_connections, protocol }
    }

    /// Returns what gives this listener new settings; `None` if another one must take its place.
    fn update(&self, kind: &ListenerKind, identity: Identity) -> Option<Update> {
        match (&self.served, kind) {
            (Served::Stream(live, units), ListenerKind::ModbusStream(new))
                if self.bind == Some(new.bind) =>
            {
                let service = ModbusStream::new(new, Arc::clone(units), live.get().packets());
                let (live, units) = (Arc::clone(live), Arc::clone(units));
                let (limits, settings) = (new.limits, new.units);
                Some(Box::new(move |listener| {
                    listener.update_units(&units, identity, settings);
                    listener.take_over(&live, service, limits);
                }))
            }
            (Served::Packets(live), ListenerKind::RawIngest(new))
                if self.bind == Some(new.bind) =>
            {
                let service = RawIngest::new(new, Arc::clone(&live.get().packets));
                let (live, limits) = (Arc::clone(live), new.limits);
                Some(Box::new(move |listener| listener.take_over(&live, service, limits)))
            }
            (Served::Datagrams(framing, live, units), ListenerKind::ModbusUdp(new))
                if self.bind == Some(new.bind) && *framing == new.framing =>
            {
                let policy = Arc::new(Policy::of(&new.rules));
                let (live, units) = (Arc::clone(live), Arc::clone(units));
                let settings = new.units;
                Some(Box::new(move |listener| {
                    listener.update_units(&units, identity, settings);
                    live.replace(policy);
                }))
            }
            (Served::Serial(line, live, units), ListenerKind::ModbusSerial(new))
                if *line == new.line =>
            {
                let rights = Arc::new(PeerRights::new(&new.rule));
                let (live, units) = (Arc::clone(live), Arc::clone(units));
                let settings = new.units;
                Some(Box::new(move |listener| {
                    listener.update_units(&units, identity, settings);
                    live.replace(rights);
                }))
            }
            _ => None,
        }
    }

    fn update_units(&self, units: &UnitServer, identity: Identity, settings: UnitSettings) {
        for unit_id in units.update(identity, settings) {
            self.context.report(Kind::UnitBack(unit_id), None);
        }
    }

    fn take_over<S: Service>(&self, live: &Reloadable<S>, service: S, limits: ConnectionLimits) {
        self.context.admission.set_limits(limits);
        let service = Arc::new(service);
        let before = live.replace(Arc::clone(&service));
        self.context.apply_reload(&*before, &*service);
    }

    fn review<S: Service>(&self, live: &Reloadable<S>) {
        self.context.review(&*live.get());
    }

    /// Stops listening and closes all connections.
    fn end(&self) {
        if let Some(task) = self.task.get() {
            task.abort();
        }
        // The task may be about to admit a connection: it ends at its next await.
        for peer in self.context.admission.close() {
            self.context.ended(Kind::RightsRevoked, peer);
        }
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.stop();
    }
}

#[cfg(test)]
mod tests;
