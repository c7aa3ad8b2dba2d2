//! Runs listeners on worker threads. Either all listeners start or none.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use holdfast_protocol::pdu::identification::ObjectError;
use thiserror::Error;
use tokio::runtime::{Builder, Handle, Runtime};
use tokio::sync::watch;

use super::admission::ConnectionLimits;
use super::audit::{Record, Records, Unrecordable, auditing};
use super::counters::{ConnectionCounters, Counters, PacketCounters};
use super::event::{Event, Events, Verbosity, channel as event_channel};
use super::identity::Identity;
use super::listener::{ListenerContext, accept, bind_tcp, bind_udp};
use super::raw_ingest::{RawIngest, RawSettings};
use super::serial::{ModbusSerial, SerialSettings};
use super::tcp::{ModbusStream, StreamSettings};
use super::udp::{ModbusUdp, UdpSettings};
use super::unit_server::UnitServer;

/// The time that connections have to end when the engine stops.
const GRACE: Duration = Duration::from_millis(500);

/// Settings of an engine.
#[derive(Debug, Clone)]
pub struct Settings {
    pub listeners: Vec<ListenerSettings>,
    /// Identification objects by id (function 43/14); 0x00 to 0x02 are mandatory.
    pub identity: Vec<(u8, Vec<u8>)>,
    /// Names of single units, by unit id.
    pub unit_names: Vec<(u8, Vec<u8>)>,
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
    listeners: Vec<Listener>,
    stop: Arc<watch::Sender<bool>>,
    workers: Mutex<Vec<JoinHandle<()>>>,
    events: Events,
    records: Option<Records>,
}

/// A running listener.
struct Listener {
    context: Arc<ListenerContext>,
    /// `None` on a serial line.
    address: Option<SocketAddr>,
    served: Served,
}

enum Served {
    /// With the packets of the same port.
    Modbus(Arc<UnitServer>, Option<Arc<RawIngest>>),
    Packets(Arc<RawIngest>),
}

/// The counters of a listener.
pub struct ListenerCounters<'e> {
    pub name: &'e str,
    pub connections: &'e ConnectionCounters,
    pub open_connections: usize,
    pub protocol: ProtocolCounters<'e>,
}

pub enum ProtocolCounters<'e> {
    /// With those of packets on the same port.
    Modbus(&'e Counters, Option<&'e PacketCounters>),
    Packets(&'e PacketCounters),
}

/// The task of a listener. All tasks are started after all listeners are bound.
type Task = Pin<Box<dyn Future<Output = ()> + Send>>;

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
        let handles: Vec<Handle> =
            runtimes.iter().map(|runtime| runtime.handle().clone()).collect();
        let mut tasks: Vec<Task> = Vec::new();
        let mut listeners = Vec::new();
        for ListenerSettings { name, kind } in settings.listeners {
            let unit_server = |listen_only| -> Result<Arc<UnitServer>, StartError> {
                let identity = Identity::new(&settings.identity, &settings.unit_names)?;
                Ok(Arc::new(UnitServer::new(identity, listen_only)))
            };
            let context = |limits: Option<ConnectionLimits>| {
                let (reporter, auditor) = (reporter.clone(), auditor.clone());
                Arc::new(ListenerContext::new(&name, limits, reporter, auditor))
            };
            let (workers, stopping) = (handles.clone(), stopping.clone());
            let listener = match kind {
                ListenerKind::ModbusStream(stream) => {
                    let (socket, address) = bound(&name, stream.bind, bind_tcp)?;
                    let context = context(Some(stream.limits));
                    let unit_server = unit_server(stream.listen_only)?;
                    let service = Arc::new(ModbusStream::new(&stream, Arc::clone(&unit_server)));
                    let raw_ingest = service.raw_ingest.clone();
                    tasks.push(Box::pin(accept(
                        Arc::clone(&context),
                        service,
                        socket,
                        workers,
                        stopping,
                    )));
                    Listener {
                        context,
                        address: Some(address),
                        served: Served::Modbus(unit_server, raw_ingest),
                    }
                }
                ListenerKind::RawIngest(raw) => {
                    let (socket, address) = bound(&name, raw.bind, bind_tcp)?;
                    let context = context(Some(raw.limits));
                    let service = Arc::new(RawIngest::new(&raw));
                    tasks.push(Box::pin(accept(
                        Arc::clone(&context),
                        Arc::clone(&service),
                        socket,
                        workers,
                        stopping,
                    )));
                    Listener { context, address: Some(address), served: Served::Packets(service) }
                }
                ListenerKind::ModbusUdp(udp) => {
                    let (socket, address) = bound(&name, udp.bind, bind_udp)?;
                    let (context, unit_server) = (context(None), unit_server(udp.listen_only)?);
                    let service = ModbusUdp::new(&udp, Arc::clone(&unit_server));
                    tasks.push(Box::pin(service.serve(Arc::clone(&context), socket, stopping)));
                    Listener {
                        context,
                        address: Some(address),
                        served: Served::Modbus(unit_server, None),
                    }
                }
                ListenerKind::ModbusSerial(serial) => {
                    let _context = handles[0].enter();
                    let device = serial.line.device.clone();
                    let port = serial.line.open().map_err(|error| StartError::Open {
                        listener: name.clone(),
                        device,
                        error,
                    })?;
                    let (context, unit_server) = (context(None), unit_server(true)?);
                    let service = ModbusSerial::new(serial, Arc::clone(&unit_server));
                    tasks.push(Box::pin(service.serve(Arc::clone(&context), port, stopping)));
                    Listener { context, address: None, served: Served::Modbus(unit_server, None) }
                }
            };
            listeners.push(listener);
        }
        for task in tasks {
            handles[0].spawn(task);
        }
        let engine =
            Engine { listeners, stop: Arc::new(stop), workers: Mutex::default(), events, records };
        for (index, runtime) in runtimes.into_iter().enumerate() {
            engine.work(index, runtime, stopping.clone())?;
        }
        Ok(engine)
    }

    /// Runs one worker until the engine stops and its connections have ended.
    fn work(
        &self,
        index: usize,
        runtime: Runtime,
        mut stopping: watch::Receiver<bool>,
    ) -> Result<(), StartError> {
        let stop = Arc::clone(&self.stop);
        let body = move || {
            runtime.block_on(async move {
                let _ = stopping.wait_for(|stop| *stop).await;
                drop(stopping);
                // Each connection and listener holds a receiver.
                let _ = tokio::time::timeout(GRACE, stop.closed()).await;
            });
        };
        let name = format!("holdfast-io-{index}");
        let thread = thread::Builder::new().name(name).spawn(body).map_err(StartError::Worker)?;
        self.workers.lock().unwrap_or_else(PoisonError::into_inner).push(thread);
        Ok(())
    }

    /// The address of each listener, in the order of the settings; `None` for serial lines.
    pub fn addresses(&self) -> Vec<Option<SocketAddr>> {
        self.listeners.iter().map(|listener| listener.address).collect()
    }

    /// The counters of each listener, in the order of the settings.
    pub fn counters(&self) -> impl Iterator<Item = ListenerCounters<'_>> {
        self.listeners.iter().map(|Listener { context, served, .. }| ListenerCounters {
            name: &context.name,
            connections: &context.connections,
            open_connections: context.admission.open(),
            protocol: match served {
                Served::Modbus(unit_server, raw) => {
                    let packets = raw.as_ref().map(|raw| &raw.packets);
                    ProtocolCounters::Modbus(&unit_server.counters, packets)
                }
                Served::Packets(service) => ProtocolCounters::Packets(&service.packets),
            },
        })
    }

    /// Takes up to `most` writes for the audit log. Waits up to `timeout` for the first.
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

    /// The next event, if one arrives within `timeout`.
    pub fn next_event(&self, timeout: Duration) -> Option<Event> {
        self.events.next(timeout)
    }

    /// The number of events that were dropped because the queue was full.
    pub fn lost_events(&self) -> u64 {
        self.events.lost()
    }

    /// Stops listening, answers what has been received, and closes every connection. Returns within
    /// a second. A second call waits for the first. Ends a wait for writes.
    pub fn stop(&self) {
        let _ = self.stop.send(true);
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        for worker in workers.drain(..) {
            let _ = worker.join();
        }
        if let Some(records) = &self.records {
            records.wake();
        }
    }
}

/// Binds a socket and returns its address.
fn bound<S: BoundSocket>(
    listener: &str,
    address: SocketAddr,
    bind: impl Fn(SocketAddr) -> io::Result<S>,
) -> Result<(S, SocketAddr), StartError> {
    let socket = bind(address).and_then(|socket| Ok((socket.address()?, socket)));
    let (address, socket) = socket.map_err(|error| StartError::Bind {
        listener: listener.to_owned(),
        address,
        error,
    })?;
    Ok((socket, address))
}

trait BoundSocket {
    fn address(&self) -> io::Result<SocketAddr>;
}

impl BoundSocket for std::net::TcpListener {
    fn address(&self) -> io::Result<SocketAddr> {
        self.local_addr()
    }
}

impl BoundSocket for std::net::UdpSocket {
    fn address(&self) -> io::Result<SocketAddr> {
        self.local_addr()
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.stop();
    }
}
