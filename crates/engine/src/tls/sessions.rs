//! Sessions that clients may resume: they have the secrets and the certificate of an earlier
//! handshake (MB-TCP-Security, R-42).
//!
//! The certificate is judged again each time, by the same rules and today's date. If it is not
//! trusted any more, the session is forgotten, and the client gets a full handshake, which refuses
//! it. Sessions are stored here and not in tickets: there is no key that could decrypt all of them, and
//! whoever changes the trusted certificates starts without sessions.

use std::collections::{HashMap, VecDeque};
use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use holdfast_runtime::lock;
use rustls::pki_types::UnixTime;
use rustls::server::StoresServerSessions;
use rustls::time_provider::TimeProvider;

use super::client_verifier::Clients;
use super::handshake_notes::{Chain, noted};

/// The most sessions. The oldest gives way.
const MAX_SESSIONS: usize = 1024;

/// The most bytes of a session and of its certificates, so that the memory for all is limited.
const MAX_LEN: usize = 8 * 1024;

/// The longest time between a full handshake and the last one that resumes its session.
const LIFETIME: Duration = Duration::from_secs(24 * 60 * 60);

pub(super) struct Sessions {
    /// `None`: clients need no certificate.
    clients: Option<Arc<Clients>>,
    clock: Arc<dyn TimeProvider>,
    stored: Mutex<Stored>,
}

#[derive(Default)]
struct Stored {
    sessions: HashMap<Vec<u8>, Session>,
    /// The keys, oldest first. Sessions may have been forgotten since.
    in_order: VecDeque<Vec<u8>>,
}

impl Stored {
    /// Forgets sessions until there are not too many.
    fn limit(&mut self) {
        let Stored { sessions, in_order } = self;
        while sessions.len() > MAX_SESSIONS
            && let Some(oldest) = in_order.pop_front()
        {
            sessions.remove(&oldest);
        }
        // A session that is resumed gets another key each time: the keys before it must not pile up.
        if in_order.len() > 2 * MAX_SESSIONS {
            in_order.retain(|key| sessions.contains_key(key));
        }
    }
}

#[derive(Clone)]
struct Session {
    secrets: Vec<u8>,
    chain: Chain,
    /// When the client proved that it has the key of its certificate, if it needs one: the time of
    /// the full handshake.
    proved: UnixTime,
}

impl Sessions {
    pub(super) fn new(clients: Option<Arc<Clients>>, clock: Arc<dyn TimeProvider>) -> Sessions {
        Sessions { clients, clock, stored: Mutex::default() }
    }

    /// Forgets a session: its connection has failed.
    pub(super) fn forget(&self, key: &[u8]) {
        lock(&self.stored).sessions.remove(key);
    }

    /// The secrets of a session whose client is still trusted.
    fn resumed(&self, key: &[u8], session: Session) -> Option<Vec<u8>> {
        let now = self.clock.current_time()?;
        let age = now.as_secs().checked_sub(session.proved.as_secs());
        let is_fresh = age.is_some_and(|age| age <= LIFETIME.as_secs());
        let is_trusted = match &self.clients {
            Some(clients) => clients.judge(&session.chain, now).is_ok(),
            None => true,
        };
        if !is_fresh || !is_trusted {
            self.forget(key);
            return None;
        }
        noted(|notes| {
            notes.chain = Some(session.chain);
            notes.proved = Some(session.proved);
            notes.session = Some(key.to_vec());
        });
        Some(session.secrets)
    }
}

impl StoresServerSessions for Sessions {
    fn put(&self, key: Vec<u8>, secrets: Vec<u8>) -> bool {
        let (mut chain, mut proved) = noted(|notes| (notes.chain.clone(), notes.proved));
        if self.clients.is_none() {
            chain = chain.or_else(|| Some(Chain::default()));
            proved = proved.or_else(|| self.clock.current_time());
        }
        let (Some(chain), Some(proved)) = (chain, proved) else { return false };
        let len = secrets.len() + chain.iter().map(|certificate| certificate.len()).sum::<usize>();
        if len > MAX_LEN {
            return false;
        }
        noted(|notes| notes.session = Some(key.clone()));
        let mut stored = lock(&self.stored);
        stored.in_order.push_back(key.clone());
        stored.sessions.insert(key, Session { secrets, chain, proved });
        stored.limit();
        true
    }

    /// For TLS 1.2, which resumes a session any number of times.
    fn get(&self, key: &[u8]) -> Option<Vec<u8>> {
        let session = lock(&self.stored).sessions.get(key).cloned()?;
        self.resumed(key, session)
    }

    /// For TLS 1.3, which resumes a session once, and then stores it with another key.
    fn take(&self, key: &[u8]) -> Option<Vec<u8>> {
        let session = lock(&self.stored).sessions.remove(key)?;
        self.resumed(key, session)
    }

    fn can_cache(&self) -> bool {
        true
    }
}

impl fmt::Debug for Sessions {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Sessions").finish_non_exhaustive()
    }
}

#[cfg(test)]
impl Sessions {
    /// Stores as many sessions as there is room for.
    pub(super) fn fill(&self) {
        let now = self.clock.current_time();
        noted(|notes| (notes.chain, notes.proved) = (Some(Chain::default()), now));
        for number in 0..MAX_SESSIONS as u64 {
            assert!(self.put(number.to_be_bytes().to_vec(), Vec::new()));
        }
        assert_eq!(lock(&self.stored).sessions.len(), MAX_SESSIONS);
        noted(std::mem::take);
    }
}

#[cfg(test)]
mod tests {
    use rustls::time_provider::DefaultTimeProvider;

    use super::*;

    #[test]
    fn a_client_that_resumes_often_displaces_no_other() {
        let sessions = Sessions::new(None, Arc::new(DefaultTimeProvider));
        let key = |number: usize| number.to_be_bytes().to_vec();
        assert!(sessions.put(key(0), b"other".to_vec()));
        for number in 1..4 * MAX_SESSIONS {
            assert!(sessions.put(key(number), Vec::new()));
            assert!(sessions.take(&key(number)).is_some());
        }
        assert_eq!(sessions.get(&key(0)).as_deref(), Some(&b"other"[..]));
        let stored = lock(&sessions.stored);
        assert!(stored.sessions.len() == 1 && stored.in_order.len() <= 2 * MAX_SESSIONS);
        drop(stored);
        noted(std::mem::take);
    }
}
