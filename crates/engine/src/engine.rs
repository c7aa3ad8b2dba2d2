//! Listeners on worker threads: started all or none, stopped clean.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use holdfast_protocol::pdu::identification::ObjectError;
use thiserror::Error;
use tokio::runtime::{Builder, Handle, Runtime};
use tokio::sync::watch;

use crate::counters::Counters;
use crate::event::{Event, Events, Verbosity, channel as event_channel};
use crate::identity::Identity;
use crate::listener::{Listener, ListenerSettings, bind};
use crate::station::Station;

/// How long connections have to end when the engine stops.
const GRACE: Duration = Duration::from_millis(500);

/// What an engine serves.
#[derive(Debug, Clone)]
pub struct Settings {
    pub listeners: Vec<ListenerSettings>,
    /// Identification objects by id (function 43/14); 0x00 to 0x02 are mandatory.
    pub identity: Vec<(u8, Vec<u8>)>,
    /// Names of single units.
    pub unit_names: Vec<(u8, Vec<u8>)>,
    /// Threads that serve connections, at least 1.
    pub workers: usize,
    pub events: Verbosity,
}

#[derive(Debug, Error)]
pub enum StartError {
    #[error("listener {listener}: can't listen on {address}: {error}")]
    Bind { listener: String, address: SocketAddr, error: io::Error },
    #[error("identity: {0}")]
    Identity(#[from] ObjectError),
    #[error("can't start a worker thread: {0}")]
    Worker(io::Error),
}

/// Listeners that serve, until it is stopped or dropped.
pub struct Engine {
    listeners: Vec<(Arc<Listener>, SocketAddr)>,
    stop: Arc<watch::Sender<bool>>,
    workers: Mutex<Vec<JoinHandle<()>>>,
    events: Events,
}

impl Engine {
    /// Binds every listener, then starts to serve. When one can't be bound, none is served.
    ///
    /// # Errors
    /// [`StartError`], with nothing left running.
    pub fn start(settings: Settings) -> Result<Engine, StartError> {
        let (reporter, events) = event_channel(settings.events);
        let (stop, stopping) = watch::channel(false);
        let mut sockets = Vec::new();
        let mut listeners = Vec::new();
        for listener in settings.listeners {
            let (name, address) = (listener.name.clone(), listener.bind);
            let failed = |error| StartError::Bind { listener: name.clone(), address, error };
            let socket = bind(address).map_err(failed)?;
            let address = socket.local_addr().map_err(failed)?;
            let station = Station::new(Identity::new(&settings.identity, &settings.unit_names)?);
            sockets.push(socket);
            listeners.push((Arc::new(Listener::new(listener, station, reporter.clone())), address));
        }
        let runtimes: Vec<Runtime> = (0..settings.workers.max(1))
            .map(|_| Builder::new_current_thread().enable_io().enable_time().build())
            .collect::<Result<_, _>>()
            .map_err(StartError::Worker)?;
        let handles: Vec<Handle> =
            runtimes.iter().map(|runtime| runtime.handle().clone()).collect();
        for ((listener, _), socket) in listeners.iter().zip(sockets) {
            let accept = Arc::clone(listener).accept(socket, handles.clone(), stopping.clone());
            handles[0].spawn(accept);
        }
        let engine = Engine { listeners, stop: Arc::new(stop), workers: Mutex::default(), events };
        for (index, runtime) in runtimes.into_iter().enumerate() {
            engine.work(index, runtime, stopping.clone())?;
        }
        Ok(engine)
    }

    /// Runs one worker: until the engine stops, and then until every connection has ended.
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
                // Every connection and listener holds a receiver.
                let _ = tokio::time::timeout(GRACE, stop.closed()).await;
            });
        };
        let name = format!("holdfast-io-{index}");
        let thread = thread::Builder::new().name(name).spawn(body).map_err(StartError::Worker)?;
        self.workers.lock().unwrap_or_else(PoisonError::into_inner).push(thread);
        Ok(())
    }

    /// Where each listener listens, in the order of the settings.
    pub fn addresses(&self) -> Vec<SocketAddr> {
        self.listeners.iter().map(|(_, address)| *address).collect()
    }

    /// Each listener's name, counters and number of open connections.
    pub fn counters(&self) -> impl Iterator<Item = (&str, &Counters, usize)> {
        self.listeners.iter().map(|(listener, _)| {
            (&*listener.name, &listener.station.counters, listener.admission.open())
        })
    }

    /// The next event, if one comes within `timeout`.
    pub fn next_event(&self, timeout: Duration) -> Option<Event> {
        self.events.next(timeout)
    }

    /// Events that were lost because nobody took them.
    pub fn lost_events(&self) -> u64 {
        self.events.lost()
    }

    /// Stops listening, answers what has been received, and ends every connection. Returns when all
    /// is done, within a second; a second call waits for the first.
    pub fn stop(&self) {
        let _ = self.stop.send(true);
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        for worker in workers.drain(..) {
            let _ = worker.join();
        }
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        self.stop();
    }
}
