//! The settings of a log that are not given. Most numbers are beside the rule that uses them.

use std::time::Duration;

use super::parts::comparer::DIGEST_STEPS;
use super::parts::continuity::ANSWER_TIMEOUT;
use super::parts::lost_messages::MAX_CUT_OFF;
use super::parts::rejoin::REJOIN_AFTER;
use super::parts::session::EXAMINE_EVERY;
use super::parts::snapshotter::{SNAPSHOT_BYTES, SNAPSHOT_STEPS};
use super::settings::{Login, Servers, Settings};
use super::stream::connection::CONNECT_TIMEOUT;

/// Until a write is answered that the log has not confirmed.
pub const WRITE_TIMEOUT: Duration = Duration::from_secs(1);

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
            refuses_when_behind: false,
            max_lag: MAX_LAG,
            snapshot_steps: SNAPSHOT_STEPS,
            snapshot_bytes: SNAPSHOT_BYTES,
            examine_every: EXAMINE_EVERY,
            digest_steps: DIGEST_STEPS,
            rejoin_after: Some(REJOIN_AFTER),
            memory_file: None,
            max_cut_off: MAX_CUT_OFF,
            answer_timeout: ANSWER_TIMEOUT,
            answers_early: false,
        }
    }
}
