//! Looks up the addresses of a name before a deadline.
//!
//! A call to the system's resolver can't be ended early. It runs in a thread, which callers leave behind when
//! their deadline passes. Who asks for a name that is being looked up waits for the same thread.

use std::collections::HashMap;
use std::io;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs};
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Instant;

/// Why a name has no addresses.
#[derive(Debug)]
pub(super) enum Unresolved {
    /// The deadline passed.
    TooLate,
    /// What the system says of the name.
    Failed(io::Error),
}

type Found = Result<Vec<SocketAddr>, Arc<io::Error>>;

/// The names that are being looked up, and who waits for them.
static UNDER_WAY: LazyLock<Mutex<HashMap<String, Vec<SyncSender<Found>>>>> =
    LazyLock::new(Mutex::default);

/// The addresses of a name or of an address in text, in the order of the system.
///
/// # Errors
/// [`Unresolved`]: the deadline passed, or the system does not know the name.
pub(super) fn addresses(
    host: &str,
    port: u16,
    deadline: Instant,
) -> Result<Vec<SocketAddr>, Unresolved> {
    if let Ok(address) = host.parse::<IpAddr>() {
        return Ok(vec![SocketAddr::new(address, port)]);
    }
    looked_up(host, port, deadline, |host| Ok((host, 0).to_socket_addrs()?.collect()))
}

fn looked_up(
    host: &str,
    port: u16,
    deadline: Instant,
    resolve: impl FnOnce(&str) -> io::Result<Vec<SocketAddr>> + Send + 'static,
) -> Result<Vec<SocketAddr>, Unresolved> {
    let (sender, found) = sync_channel(1);
    let is_first = {
        let mut all = under_way();
        let waiting = all.entry(host.to_owned()).or_default();
        waiting.push(sender);
        waiting.len() == 1
    };
    if is_first {
        let name = host.to_owned();
        let work = move || finish(&name, &resolve(&name).map_err(Arc::new));
        let lookup = thread::Builder::new().name("holdfast-lookup".into());
        if let Err(error) = lookup.spawn(work) {
            finish(host, &Err(Arc::new(error)));
        }
    }
    let left = deadline.saturating_duration_since(Instant::now());
    match found.recv_timeout(left) {
        Ok(Ok(mut addresses)) => {
            addresses.iter_mut().for_each(|address| address.set_port(port));
            Ok(addresses)
        }
        Ok(Err(error)) => Err(Unresolved::Failed(io::Error::new(error.kind(), error))),
        Err(RecvTimeoutError::Timeout) => Err(Unresolved::TooLate),
        Err(RecvTimeoutError::Disconnected) => unreachable!("a lookup has a result"),
    }
}

/// Hands a result to all who wait for it. Whoever was too late does not receive it.
fn finish(host: &str, found: &Found) {
    for waiting in under_way().remove(host).unwrap_or_default() {
        let _ = waiting.send(found.clone());
    }
}

fn under_way() -> MutexGuard<'static, HashMap<String, Vec<SyncSender<Found>>>> {
    UNDER_WAY.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;
    use std::time::Duration;

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
        let late = looked_up("slow.test", 502, Instant::now(), slow);
        assert!(matches!(late, Err(Unresolved::TooLate)));
        let again = thread::spawn(|| {
            looked_up("slow.test", 802, later(60), |_| unreachable!("it is looked up already"))
        });
        while under_way().get("slow.test").is_some_and(|waiting| waiting.len() < 2) {
            thread::yield_now();
        }
        go_on.send(()).unwrap();
        assert_eq!(again.join().unwrap().unwrap(), ["192.0.2.1:802".parse().unwrap()]);
        let anew = looked_up("slow.test", 1, later(60), |_| Ok(Vec::new()));
        assert_eq!(anew.unwrap(), []);
    }

    #[test]
    fn a_failed_lookup_is_what_the_system_says() {
        let unknown = |_: &str| Err(io::Error::other("the name is not known"));
        match looked_up("unknown.test", 502, later(60), unknown) {
            Err(Unresolved::Failed(error)) => {
                assert_eq!(error.to_string(), "the name is not known")
            }
            other => panic!("{other:?}"),
        }
    }
}
