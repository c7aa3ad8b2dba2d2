//! Settings of a log, and what they allow.

use std::path::PathBuf;
use std::time::Duration;

use super::error::LogError;

/// Where the servers are, and how to connect to them. Files are read again for each connection.
#[derive(Debug, Clone)]
pub struct Servers {
    pub urls: Vec<String>,
    pub login: Login,
    pub tls: Option<Tls>,
    /// How long one attempt to connect may take.
    pub connect_timeout: Duration,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Login {
    #[default]
    None,
    User {
        name: String,
        password_file: Option<PathBuf>,
    },
    Token {
        file: PathBuf,
    },
    /// A file with a JWT and a seed, as `nsc` writes it.
    Credentials {
        file: PathBuf,
    },
}

/// TLS with the servers.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Tls {
    /// The trusted authorities, in place of those of the system.
    pub ca: Option<PathBuf>,
    pub identity: Option<ClientIdentity>,
}

/// With what this client proves to the servers who it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ClientIdentity {
    pub cert: PathBuf,
    pub key: PathBuf,
}

#[derive(Debug, Clone)]
pub struct Settings {
    /// The name of the log: all nodes with this name share the same contents.
    pub name: String,
    /// The name of this node, unique in the log.
    pub node: String,
    pub servers: Servers,
    /// Of the stream, if this node creates it: 1, 3 or 5.
    pub replicas: usize,
    /// How long a write waits for its confirmation.
    pub write_timeout: Duration,
    /// Whether reads are refused with [`Refusal::Behind`](holdfast_memory::Refusal) after `max_lag` without
    /// contact with the log.
    pub refuses_when_behind: bool,
    pub max_lag: Duration,
    /// A snapshot is taken after so many steps.
    pub snapshot_steps: u64,
    /// A snapshot is also taken after so many bytes of messages.
    #[doc(hidden)]
    pub snapshot_bytes: u64,
    /// How often to look whether the servers still have what the log begins with.
    #[doc(hidden)]
    pub examine_every: Duration,
    /// Digests are compared at sequences that are multiples of this.
    pub digest_steps: u64,
    /// A node whose contents differ rejoins by itself, unless it has done so within this time; with
    /// `None`, never.
    pub rejoin_after: Option<Duration>,
    /// The file that stores the memories, for messages of errors.
    pub memory_file: Option<String>,
    /// For so long, a server may know less than this node: it may be cut off from the other servers.
    pub max_cut_off: Duration,
    /// How long a node that starts waits for an answer of another node before seals that open once are closed.
    #[doc(hidden)]
    pub answer_timeout: Duration,
    /// Writes are answered when they are sent. Tests use it to show what then goes wrong.
    #[doc(hidden)]
    pub answers_early: bool,
}

impl Settings {
    /// # Errors
    /// [`LogError::Settings`], which names the setting.
    pub fn check(&self) -> Result<(), LogError> {
        let refused = |text: String| Err(LogError::Settings(text));
        let (name, node) = (&self.name, &self.node);
        for (what, name, checked) in
            [("name", name, check_name(name)), ("node", node, check_node(node))]
        {
            if let Err(allowed) = checked {
                return refused(format!("{what} is {name:?}, allowed: {allowed}"));
            }
        }
        if self.servers.urls.is_empty() {
            return refused("servers are empty, at least one URL is required".to_owned());
        }
        if !matches!(self.replicas, 1 | 3 | 5) {
            return refused(format!("replicas is {}, allowed: 1, 3, 5", self.replicas));
        }
        for (what, found) in
            [("snapshot_steps", self.snapshot_steps), ("digest_steps", self.digest_steps)]
        {
            if found == 0 {
                return refused(format!("{what} is 0, at least 1 is required"));
            }
        }
        for (what, found) in [("write_timeout", self.write_timeout), ("max_lag", self.max_lag)] {
            if found < MIN_TIMEOUT {
                let (found, least) = (found.as_secs_f64(), MIN_TIMEOUT.as_secs_f64());
                return refused(format!("{what} is {found} s, at least {least} s is required"));
            }
        }
        Ok(())
    }

    /// How often a node without writes proves its contact with the log.
    pub(super) fn contact_interval(&self) -> Duration {
        self.max_lag / CONTACTS_PER_LAG
    }

    /// How long a session may have no contact before another one is tried.
    pub(super) fn max_silence(&self) -> Duration {
        (self.contact_interval() * 3).max(Duration::from_secs(2))
    }
}

/// In this part of `max_lag`, a node without writes has contact with the log once.
pub const CONTACTS_PER_LAG: u32 = 4;

const MAX_NAME_CHARS: usize = 64;

/// No duration in the settings of a log is shorter.
const MIN_TIMEOUT: Duration = Duration::from_millis(50);

/// Each log has buckets with its own name and these endings. A log whose name ends so would have its keys in a
/// bucket of another log, where they expire, or are taken for leases.
const BUCKETS_OF_LEASES: [&str; 2] = ["-leases", "-devices"];

/// Checks the name of a log.
///
/// # Errors
/// What is allowed.
pub fn check_name(name: &str) -> Result<(), String> {
    check_node(name)?;
    match BUCKETS_OF_LEASES.iter().find(|ending| name.ends_with(**ending)) {
        Some(ending) => {
            Err(format!("a name that does not end in {ending}, as buckets of another log do"))
        }
        None => Ok(()),
    }
}

/// Checks the name of a node.
///
/// # Errors
/// What is allowed.
pub fn check_node(name: &str) -> Result<(), String> {
    if is_word(name) {
        return Ok(());
    }
    Err(format!("1 to {MAX_NAME_CHARS} letters, digits, - and _"))
}

/// Whether a name can be part of a subject, of a stream's name and of a key.
pub(super) fn is_word(name: &str) -> bool {
    let is_allowed = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_');
    (1..=MAX_NAME_CHARS).contains(&name.len()) && name.bytes().all(is_allowed)
}
