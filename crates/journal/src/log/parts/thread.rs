//! The thread of a log: sessions with the servers, one after the other.

use std::time::{Duration, Instant};

use holdfast_runtime::Retry;

use crate::log::error::{End, LogError};
use crate::log::parts::node::{CHECK_INTERVAL, Node};
use crate::log::parts::session;
use crate::log::status::{Event, Phase};

/// Pauses between sessions. Many nodes share the servers.
const RETRY: Retry =
    Retry { first: Duration::from_millis(50), most: Duration::from_secs(1), jitter: true };

/// Runs sessions until the log is stopped, or can't go on.
pub(in crate::log) fn run(mut node: Node) {
    let mut failures = 0_u32;
    while !node.shared.is_stopping() {
        let (end, has_caught_up) = run_session(&mut node);
        node.shared.close();
        match end {
            End::Stopped => break,
            // A file that can't be read now can be read later.
            End::Fatal(LogError::Settings(reason)) if node.applier.stream_id().is_some() => {
                lost(&node, reason);
            }
            End::Fatal(error) => {
                node.sender.expire_all();
                if !node.rejoin.may_rejoin(&error) {
                    return fail(&node, error);
                }
                node.drop_contents(error);
            }
            End::Lost(reason) => lost(&node, reason),
        }
        if has_caught_up {
            failures = 0;
        }
        failures = failures.saturating_add(1);
        wait(&mut node, RETRY.pause(failures));
    }
    node.sender.expire_all();
    node.shared.give_last_checkpoint(node.checkpoint());
    node.shared.update(|view| {
        view.phase = Phase::Stopped;
        view.server = None;
    });
}

/// Runs a session. Returns why it has ended, and whether the node had caught up.
fn run_session(node: &mut Node) -> (End, bool) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    match runtime {
        Ok(runtime) => {
            let ended = runtime.block_on(session::run(node));
            // All tasks of the client end here, with all that it has not sent.
            runtime.shutdown_background();
            ended
        }
        Err(error) => (End::lost("starting a runtime", error), false),
    }
}

/// The log can't go on.
fn fail(node: &Node, error: LogError) {
    // What the file is to keep has to be right. All other errors are about the log, not the contents.
    let contents_are_right = !matches!(error, LogError::Differs { .. });
    node.shared.give_last_checkpoint(node.checkpoint().filter(|_| contents_are_right));
    node.shared.fail(error);
}

/// The session has ended, or none could begin. The next one may do better.
fn lost(node: &Node, reason: String) {
    let before = node.shared.view();
    if before.server.is_some() {
        node.shared.event(Event::new("log_disconnected", &[("reason", &reason)]));
    } else if before.last_error.as_ref() != Some(&reason) {
        // Only once for each reason, not for each attempt.
        node.shared.event(Event::new("log_connect_failed", &[("reason", &reason)]));
    }
    node.shared.update(|view| {
        view.server = None;
        view.last_error = Some(reason);
    });
}

fn wait(node: &mut Node, pause: Duration) {
    let until = Instant::now() + pause;
    while Instant::now() < until && !node.shared.is_stopping() {
        std::thread::sleep(CHECK_INTERVAL.min(pause));
        node.keep_deadlines(Instant::now());
    }
}
