//! Looks up the addresses of names.
//!
//! A call to the system's resolver can't be ended early. It runs in a thread, which callers leave behind when
//! their time is over. Who asks for a name that is being looked up waits for the same thread. Addresses that
//! came when nobody waited any more are for the next attempts of those who have left: a lookup may take longer than
//! each attempt.

use std::collections::{HashMap, VecDeque};
use std::io;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard};
use std::time::{Duration, Instant};
use std::{mem, process, thread};

use holdfast_runtime::lock;
use tokio::sync::oneshot;

/// Why a name has no addresses.
#[derive(Debug)]
pub(crate) enum Unresolved {
    /// The deadline passed.
    TooLate,
    /// The lookup failed.
    Failed(io::Error),
}

/// The addresses have port 0.
type Found = Result<Vec<SocketAddr>, Arc<io::Error>>;

/// Returns whether the result is taken: the caller may have left.
type Waiting = Box<dyn FnOnce(Found) -> bool + Send>;

/// Threads at most; the lookups of further names wait.
const MAX_THREADS: usize = 512;

/// How long addresses are kept that came too late: as long as the longest usual pause between two attempts.
const KEPT: Duration = Duration::from_secs(60);

static LOOKUPS: LazyLock<Mutex<Lookups>> = LazyLock::new(Mutex::default);

#[derive(Default)]
struct Lookups {
    /// The process that has the threads: a forked child does not have them.
    process: u32,
    threads: usize,
    /// Who waits for each name.
    waiting: HashMap<String, Vec<Waiting>>,
    /// What no thread has begun.
    queue: VecDeque<Box<dyn FnOnce() + Send>>,
    /// What came when all who had asked had left.
    late: HashMap<String, Late>,
}

struct Late {
    came: Instant,
    addresses: Vec<SocketAddr>,
    /// How many may still have them: each who had asked once.
    left: usize,
}

impl Lookups {
    /// The addresses of a name that came too late, once for each who had asked.
    fn take_late(&mut self, host: &str) -> Option<Vec<SocketAddr>> {
        self.late.retain(|_, late| late.left > 0 && late.came.elapsed() < KEPT);
        let late = self.late.get_mut(host)?;
        late.left -= 1;
        Some(late.addresses.clone())
    }
}

/// The addresses of a name or of an address in text, in the order of the system.
///
/// # Errors
/// [`Unresolved`]: the deadline passed, or the system does not know the name.
pub(crate) fn addresses(
    host: &str,
    port: u16,
    deadline: Instant,
) -> Result<Vec<SocketAddr>, Unresolved> {
    match host.parse::<IpAddr>() {
        Ok(address) => Ok(vec![SocketAddr::new(address, port)]),
        Err(_) => addresses_by(host, port, deadline, resolve),
    }
}

fn addresses_by(
    host: &str,
    port: u16,
    deadline: Instant,
    resolve: impl FnOnce(&str) -> io::Result<Vec<SocketAddr>> + Send + 'static,
) -> Result<Vec<SocketAddr>, Unresolved> {
    let (sender, found) = sync_channel(1);
    // Fails if the caller's time is over.
    look_up(host, Box::new(move |found| sender.send(found).is_ok()), resolve);
    let left = deadline.saturating_duration_since(Instant::now());
    match found.recv_timeout(left) {
        Ok(found) => with_port(found, port).map_err(Unresolved::Failed),
        Err(RecvTimeoutError::Timeout) => Err(Unresolved::TooLate),
        Err(RecvTimeoutError::Disconnected) => unreachable!("a lookup has a result"),
    }
}

/// The same for tasks, without a deadline.
///
/// # Errors
/// What the system says of the name.
pub(crate) async fn addresses_of(host: &str, port: u16) -> io::Result<Vec<SocketAddr>> {
    if let Ok(address) = host.parse::<IpAddr>() {
        return Ok(vec![SocketAddr::new(address, port)]);
    }
    let (sender, found) = oneshot::channel();
    look_up(host, Box::new(move |found| sender.send(found).is_ok()), resolve);
    with_port(found.await.expect("a lookup has a result"), port)
}

/// The time for one address of a name that `others` follow. Each gets the same share of what is left, so that
/// one dead address does not use it up.
pub(crate) fn share(deadline: Instant, others: usize) -> Duration {
    let addresses = u32::try_from(others + 1).unwrap_or(u32::MAX);
    deadline.saturating_duration_since(Instant::now()) / addresses
}

fn resolve(host: &str) -> io::Result<Vec<SocketAddr>> {
    Ok((host, 0).to_socket_addrs()?.collect())
}

fn with_port(found: Found, port: u16) -> io::Result<Vec<SocketAddr>> {
    let mut addresses = found.map_err(|error| io::Error::new(error.kind(), error))?;
    addresses.iter_mut().for_each(|address| address.set_port(port));
    Ok(addresses)
}

fn look_up(
    host: &str,
    waiting: Waiting,
    resolve: impl FnOnce(&str) -> io::Result<Vec<SocketAddr>> + Send + 'static,
) {
    let mut all = lookups();
    if all.process != process::id() {
        let of_parent =
            mem::replace(&mut *all, Lookups { process: process::id(), ..Lookups::default() });
        // Dropping what waits would wake tasks of the parent's event loops.
        mem::forget(of_parent);
    }
    if let Some(others) = all.waiting.get_mut(host) {
        return others.push(waiting);
    }
    if let Some(addresses) = all.take_late(host) {
        drop(all);
        waiting(Ok(addresses));
        return;
    }
    all.waiting.insert(host.to_owned(), vec![waiting]);
    let name = host.to_owned();
    all.queue.push_back(Box::new(move || {
        // The errors of the resolver have no useful kind.
        let unknown = |error| Arc::new(io::Error::new(io::ErrorKind::NotFound, error));
        finish(&name, &resolve(&name).map_err(unknown));
    }));
    if all.threads == MAX_THREADS {
        return;
    }
    all.threads += 1;
    drop(all);
    let thread = thread::Builder::new().name("holdfast-lookup".into());
    if let Err(error) = thread.spawn(work) {
        refuse(&error);
    }
}

/// Carries out lookups until none waits.
fn work() {
    loop {
        let mut all = lookups();
        let Some(lookup) = all.queue.pop_front() else {
            all.threads -= 1;
            return;
        };
        drop(all);
        lookup();
    }
}

/// No thread could be started. If another one runs, it carries out what waits.
fn refuse(error: &io::Error) {
    let mut all = lookups();
    all.threads -= 1;
    if all.threads > 0 {
        return;
    }
    all.queue.clear();
    let waiting = mem::take(&mut all.waiting);
    drop(all);
    let error = io::Error::other(format!("can't start a thread to look up the name: {error}"));
    let error = Arc::new(error);
    for waiting in waiting.into_values().flatten() {
        waiting(Err(Arc::clone(&error)));
    }
}

/// Hands a result to all who wait for it. If all have left, addresses are kept for them.
fn finish(host: &str, found: &Found) {
    let waiting = lookups().waiting.remove(host).unwrap_or_default();
    let asked = waiting.len();
    let mut is_taken = false;
    for waiting in waiting {
        is_taken |= waiting(found.clone());
    }
    if let (false, Ok(addresses)) = (is_taken, found) {
        let late = Late { came: Instant::now(), addresses: addresses.clone(), left: asked };
        lookups().late.insert(host.to_owned(), late);
    }
}

fn lookups() -> MutexGuard<'static, Lookups> {
    lock(&LOOKUPS)
}

/// Begins a lookup that has no result before the sender is dropped.
#[cfg(test)]
pub(crate) fn hold(host: &str) -> std::sync::mpsc::Sender<()> {
    let (sender, held) = std::sync::mpsc::channel();
    let resolve = move |_: &str| {
        let _ = held.recv();
        Ok(Vec::new())
    };
    look_up(host, Box::new(|_| true), resolve);
    sender
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use super::*;

    fn later(seconds: u64) -> Instant {
        Instant::now() + Duration::from_secs(seconds)
    }

    #[test]
    fn an_address_needs_no_lookup() {
        let found = addresses("::1", 502, Instant::now()).unwrap();
        assert_eq!(found, ["[::1]:502".parse().unwrap()]);
    }

    #[test]
    fn a_deadline_ends_the_wait_and_the_next_caller_has_the_result_of_the_same_lookup() {
        let (go_on, held) = channel::<()>();
        let slow = move |_: &str| {
            held.recv().unwrap();
            Ok(vec!["192.0.2.1:0".parse().unwrap()])
        };
        let late = addresses_by("slow.test", 502, Instant::now(), slow);
        assert!(matches!(late, Err(Unresolved::TooLate)));
        let again = thread::spawn(|| {
            addresses_by("slow.test", 802, later(60), |_| unreachable!("it is looked up already"))
        });
        while lookups().waiting.get("slow.test").is_some_and(|waiting| waiting.len() < 2) {
            thread::yield_now();
        }
        go_on.send(()).unwrap();
        assert_eq!(again.join().unwrap().unwrap(), ["192.0.2.1:802".parse().unwrap()]);
        let anew = addresses_by("slow.test", 1, later(60), |_| Ok(Vec::new()));
        assert_eq!(anew.unwrap(), []);
    }

    #[test]
    fn addresses_that_came_too_late_are_for_the_next_attempts_of_those_who_had_asked() {
        let late = |host: &str| {
            let (go_on, held) = channel::<()>();
            let slow = move |_: &str| {
                held.recv().unwrap();
                Ok(vec!["192.0.2.1:0".parse().unwrap()])
            };
            let first = addresses_by(host, 502, Instant::now(), slow);
            assert!(matches!(first, Err(Unresolved::TooLate)));
            go_on.send(()).unwrap();
            while !lookups().late.contains_key(host) {
                thread::yield_now();
            }
        };
        late("late.test");
        let next = |_: &str| unreachable!("its addresses have come");
        let found = addresses_by("late.test", 802, later(60), next).unwrap();
        assert_eq!(found, ["192.0.2.1:802".parse().unwrap()]);
        assert_eq!(addresses_by("late.test", 1, later(60), |_| Ok(Vec::new())).unwrap(), []);

        late("old.test");
        lookups().late.get_mut("old.test").unwrap().came -= KEPT;
        assert_eq!(addresses_by("old.test", 1, later(60), |_| Ok(Vec::new())).unwrap(), []);
    }

    #[test]
    fn a_failed_lookup_is_what_the_system_says() {
        let unknown = |_: &str| Err(io::Error::other("the name is not known"));
        match addresses_by("unknown.test", 502, later(60), unknown) {
            Err(Unresolved::Failed(error)) => {
                assert_eq!(error.to_string(), "the name is not known");
                assert_eq!(error.kind(), io::ErrorKind::NotFound);
            }
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_lookup_that_has_no_thread_is_not_an_unknown_name() {
        let no_thread = Arc::new(io::Error::other("can't start a thread to look up the name"));
        let error = with_port(Err(no_thread), 502).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::Other);
        assert_eq!(error.to_string(), "can't start a thread to look up the name");
    }
}
