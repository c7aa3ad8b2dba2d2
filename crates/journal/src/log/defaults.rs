//! The settings of a log that are not given. Each number is beside the rule that uses it.

use std::time::Duration;

use super::parts::comparer::DIGEST_EVERY;
use super::parts::snapshotter::{SNAPSHOT_AFTER, SNAPSHOT_STEPS};
use super::parts::wrong_contents::REJOIN_AFTER;
use super::settings::{Login, Servers, Settings, WhenBehind};
use super::shared::MAX_QUEUE_STEPS;
use super::stream::connection::CONNECT_TIMEOUT;
use super::stream::server_lag::MAX_CUT_OFF;

/// Until a write is answered that the log has not confirmed.
pub const WRITE_TIMEOUT: Duration = Duration::from_secs(1);

pub const WHEN_BEHIND: WhenBehind = WhenBehind::Serve;

/// Without contact to the log, until the node is behind.
pub const MAX_LAG: Duration = Duration::from_secs(5);

impl Settings {
    pub fn new(name: &str, node: &str, urls: Vec<String>) -> Settings {
        Settings {
            name: name.to_owned(),
            node: node.to_owned(),
            servers: Servers {
                urls,
                login: Login::None,
                tls: None,
                connect_timeout: CONNECT_TIMEOUT,
            },
            replicas: 1,
            write_timeout: WRITE_TIMEOUT,
            when_behind: WHEN_BEHIND,
            max_lag: MAX_LAG,
            snapshot_steps: SNAPSHOT_STEPS,
            snapshot_after: SNAPSHOT_AFTER,
            digest_every: DIGEST_EVERY,
            queue: MAX_QUEUE_STEPS,
            rejoin_after: Some(REJOIN_AFTER),
            memory_file: None,
            max_cut_off: MAX_CUT_OFF,
            answers_early: false,
        }
    }
}
