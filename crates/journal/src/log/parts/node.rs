//! A node of a log: the parts that outlast a session, and what they owe to others meanwhile.
//!
//! | part | decides |
//! | --- | --- |
//! | [`Applier`] | what a message of the stream does |
//! | [`Sender`] | what is sent, and the outcome that writers see |
//! | [`Snapshotter`] | when a snapshot is taken and stored |
//! | [`Comparer`] | whether digests of nodes agree |
//! | [`Rejoin`] | whether the contents are right |
//! | [`Continuity`] | whether seals that open once may stay open |
//! | [`LostMessages`] | whether the servers have lost messages |
//!
//! The parts do not know each other. A session passes on what one of them finds out.

use std::sync::Arc;
use std::time::{Duration, Instant};

use holdfast_memory::Memory;

use crate::log::error::{End, LogError};
use crate::log::parts::applier::Applier;
use crate::log::parts::comparer::Comparer;
use crate::log::parts::continuity::Continuity;
use crate::log::parts::lost_messages::LostMessages;
use crate::log::parts::rejoin::Rejoin;
use crate::log::parts::sender::Sender;
use crate::log::parts::snapshotter::Snapshotter;
use crate::log::settings::Settings;
use crate::log::shared::{Checkpoint, Shared};
use crate::log::status::Event;
use crate::log::stream::connection::ConnectionEnd;

/// How often deadlines are checked.
pub(in crate::log) const CHECK_INTERVAL: Duration = Duration::from_millis(20);

/// What lasts from one session to the next.
pub(in crate::log) struct Node {
    pub(in crate::log) settings: Arc<Settings>,
    pub(in crate::log) shared: Arc<Shared>,
    /// The end of the connection of this session, if there is one.
    pub(in crate::log) connection_end: Option<ConnectionEnd>,
    /// The layout of the memories.
    pub(in crate::log) fingerprint: String,
    pub(in crate::log) applier: Applier,
    pub(in crate::log) sender: Sender,
    pub(in crate::log) snapshotter: Snapshotter,
    pub(in crate::log) comparer: Comparer,
    pub(in crate::log) rejoin: Rejoin,
    pub(in crate::log) continuity: Continuity,
    pub(in crate::log) lost_messages: LostMessages,
}

impl Node {
    pub(in crate::log) fn new(
        settings: Arc<Settings>,
        fingerprint: String,
        shared: Arc<Shared>,
        members: Vec<Arc<Memory>>,
    ) -> Node {
        let continuity = Continuity::new(&settings, &members);
        Node {
            applier: Applier::new(&settings, &shared, members),
            sender: Sender::new(&settings, &shared),
            snapshotter: Snapshotter::new(&settings, &shared),
            comparer: Comparer::new(&settings, &shared),
            rejoin: Rejoin::new(&settings, &shared),
            continuity,
            lost_messages: LostMessages::new(settings.max_cut_off),
            fingerprint,
            settings,
            shared,
            connection_end: None,
        }
    }

    pub(in crate::log) fn begin_session(&mut self) {
        self.connection_end = None;
        self.lost_messages.begin_session();
        self.snapshotter.begin_session();
        self.comparer.begin_session();
        self.continuity.begin_session(Instant::now());
    }

    /// The stream is on this many servers: it keeps those with which it was made, until an operator
    /// changes that.
    pub(in crate::log) fn learn_replicas(&self, found: usize) {
        let configured = self.settings.replicas;
        if found != configured && found != self.shared.view().replicas {
            let (found, configured) = (found.to_string(), configured.to_string());
            let fields = [("replicas", found.as_str()), ("configured", configured.as_str())];
            self.shared.event(Event::new("log_replicas_differ", &fields));
        }
        self.shared.update(|view| view.replicas = found);
    }

    /// The contents are wrong: the next session loads a snapshot.
    pub(in crate::log) fn drop_contents(&mut self, error: LogError) {
        self.comparer.forget();
        self.rejoin.drop_contents(error);
    }

    /// What the file is to keep, unless the contents are wrong or not there yet.
    pub(in crate::log) fn checkpoint(&self) -> Option<Checkpoint> {
        self.applier.checkpoint().filter(|_| self.rejoin.contents_are_right())
    }

    /// What has to be done in time, whatever this node waits for: the file is given what it asks for, and
    /// writers learn that their steps were not confirmed.
    pub(in crate::log) fn keep_deadlines(&mut self, now: Instant) {
        // While a snapshot is loaded, the file waits.
        if self.shared.is_checkpoint_requested() && self.applier.has_contents() {
            self.shared.give_checkpoint(self.checkpoint());
        }
        self.sender.expire(now);
    }

    /// Waits for something, at most until the connection ends, and meanwhile keeps the deadlines.
    pub(in crate::log) async fn run_with_expiry<T>(
        &mut self,
        work: impl Future<Output = T>,
    ) -> Result<T, End> {
        let mut connection = self.connection_end.clone();
        let ended = async {
            match &mut connection {
                Some(connection) => connection.wait().await,
                None => std::future::pending().await,
            }
        };
        let (mut work, mut ended) = (std::pin::pin!(work), std::pin::pin!(ended));
        loop {
            tokio::select! {
                biased;
                done = &mut work => return Ok(done),
                end = &mut ended => return Err(end),
                () = tokio::time::sleep(CHECK_INTERVAL) => {
                    self.keep_deadlines(Instant::now());
                    if self.shared.is_stopping() {
                        return Err(End::Stopped);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_waits_for_an_answer_over_a_connection_that_has_ended() {
        let settings = Arc::new(Settings::new("site", "a", Vec::new()));
        let shared = Arc::new(Shared::new(&settings));
        let mut node = Node::new(settings, String::new(), shared, Vec::new());
        let (end, connection_end) = ConnectionEnd::channel();
        node.connection_end = Some(connection_end);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let ended = runtime.block_on(async {
            tokio::spawn(async move { end.send_replace(Some("it has ended".to_owned())) });
            node.run_with_expiry(std::future::pending::<()>()).await
        });
        assert!(matches!(ended, Err(End::Lost(reason)) if reason == "it has ended"));
    }
}
