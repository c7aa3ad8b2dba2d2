//! Where a session begins to read the stream, and with which contents. Whether the servers have lost
//! messages.

use crate::log::error::{End, LogError};
use crate::log::parts::node::Node;
use crate::log::shared::Shared;
use crate::log::state::{State, StreamPosition, digest_of};
use crate::log::status::Event;
use crate::log::stream::store::{Pointer, Snapshot, Store};

/// Loads a snapshot if that is needed. Returns the sequence to read from.
pub(in crate::log) async fn join(node: &mut Node, store: &Store) -> Result<u64, End> {
    let id = store.id().map(str::to_owned);
    let is_known = node.applier.stream_id().is_some();
    if is_known && node.applier.stream_id() != id.as_deref() {
        let text = "the stream of the log was deleted and made anew".to_owned();
        return Err(node.applier.replaced(text).into());
    }
    let (first, end) = {
        let info = &store.stream.cached_info().state;
        let stored = info.last_timestamp.unix_timestamp_nanos() as i64;
        (info.first_sequence, StreamPosition { sequence: info.last_sequence, stored })
    };
    let position = node.applier.state().position;
    if end.sequence < position.sequence {
        return Err(servers_behind(
            node,
            format!(
                "the stream ends at {end}, but this node has applied {position}: the servers have lost \
                 messages"
            ),
        ));
    }
    // The next message was removed behind a snapshot: this node was away for too long.
    let is_gone = first > position.sequence + 1;
    if !is_known || is_gone || node.rejoin.needs_snapshot() {
        load(node, store, first, end.sequence).await?;
        node.rejoin.reloaded();
    }
    node.applier.joined(id);
    // What was applied last is read again, to see that it is still the same.
    let applied = node.applier.sequence();
    Ok(if applied >= first.max(1) { applied } else { applied + 1 })
}

/// The servers know less than this node.
pub(in crate::log) fn servers_behind(node: &mut Node, text: String) -> End {
    let error = node.applier.replaced(text);
    node.lost_messages.judge(error)
}

/// Loads the newest snapshot that is good, or makes the first one. The stream goes from `first` to `last`.
async fn load(node: &mut Node, store: &Store, first: u64, last: u64) -> Result<(), End> {
    let pointer = node.run_with_expiry(store.pointer()).await??;
    let Some((revision, pointer)) = pointer else {
        if last > 0 {
            let text = "the log has messages, but the key of its snapshot is missing: it was deleted, or a \
                        restore was cut short";
            return Err(match servers_behind(node, text.to_owned()) {
                // The contents of this node need not differ from those of the log.
                End::Fatal(_) => LogError::Snapshot(text.to_owned()).into(),
                other => other,
            });
        }
        return create_first(node, store).await;
    };
    if pointer.newest.sequence > last {
        let sequence = pointer.newest.sequence;
        return Err(servers_behind(
            node,
            format!(
                "the stream ends at sequence {last}, but there is a snapshot at {sequence}: the \
                 servers have lost messages"
            ),
        ));
    }
    // A node whose contents were wrong does not trust what it has stored itself.
    let distrusted = (!node.rejoin.contents_are_right()).then(|| node.settings.node.clone());
    let Some(order) = load_order(&pointer, distrusted.as_deref(), first) else {
        // It keeps its contents: those of the snapshot are older, or lead to nothing.
        let own = if node.rejoin.needs_snapshot() { 0 } else { node.applier.sequence() };
        return Err(End::missing(pointer.newest.sequence.max(own) + 1, first - 1));
    };
    let (shared, mut state) = (node.shared.clone(), node.applier.begin_load());
    let loading = load_good(store, order, revision, &shared, &mut state);
    let loaded = node.run_with_expiry(loading).await.and_then(|loaded| loaded);
    if loaded.is_ok() {
        node.sender.loaded(&state);
    }
    node.applier.end_load(state, loaded.is_ok());
    loaded?;
    node.snapshotter.learn(revision, pointer);
    Ok(())
}

/// The first node that gets here decides what the log begins with.
async fn create_first(node: &mut Node, store: &Store) -> Result<(), End> {
    let state = node.applier.state();
    let encoded = state.encode();
    let snapshot = Snapshot::of(state, digest_of(&encoded), &node.settings.node);
    let limit = node.shared.message_limit.clone();
    let first = node.run_with_expiry(store.put(&limit, None, &encoded, snapshot)).await?;
    let (revision, pointer) = first.map_err(|error| End::lost("the first snapshot", error))?;
    node.snapshotter.learn(revision, pointer);
    Ok(())
}

/// The snapshots that the stream continues, in the order in which they are tried. `None` if messages behind
/// the newest one were removed.
///
/// None of them leads a node back: it loads one because its own next message was removed, or because its
/// contents are wrong or none yet.
fn load_order<'p>(
    pointer: &'p Pointer,
    distrusted: Option<&str>,
    first: u64,
) -> Option<(&'p Snapshot, Option<&'p Snapshot>)> {
    let Pointer { newest, previous } = pointer;
    let mut known = [Some(newest), previous.as_ref()];
    if distrusted == Some(newest.node.as_str()) {
        known.reverse();
    }
    let is_continued = |snapshot: &&Snapshot| snapshot.sequence + 1 >= first;
    let mut order = known.into_iter().flatten().filter(is_continued);
    order.next().map(|one| (one, order.next()))
}

/// Loads the first snapshot, or the second if the first is damaged.
async fn load_good(
    store: &Store,
    (first, second): (&Snapshot, Option<&Snapshot>),
    revision: u64,
    shared: &Shared,
    state: &mut State,
) -> Result<(), End> {
    let mut loaded = store.load(first, state).await;
    if let (Err(End::Fatal(error)), Some(second)) = (&loaded, second) {
        shared.event(Event::new("log_snapshot_damaged", &[("reason", &error.to_string())]));
        loaded = store.load(second, state).await;
    }
    // Other nodes may have stored snapshots meanwhile, and removed these.
    if matches!(loaded, Err(End::Fatal(_)))
        && let Ok(Some((now, _))) = store.pointer().await
        && now != revision
    {
        return Err(End::Lost("the snapshot was replaced".to_owned()));
    }
    loaded.map_err(|end| match end {
        End::Fatal(LogError::Snapshot(text)) => {
            let helps = "only the next snapshot of a node that runs helps, or a backup";
            LogError::Snapshot(format!("{text}: {helps}")).into()
        }
        other => other,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn snapshot(sequence: u64, node: &str) -> Snapshot {
        Snapshot {
            sequence,
            stored: 0,
            steps: 0,
            object: String::new(),
            digest: String::new(),
            node: node.to_owned(),
            nuid: None,
        }
    }

    #[test]
    fn a_node_whose_contents_were_wrong_first_tries_the_snapshot_of_another_node() {
        let (newest, previous) = (snapshot(2, "a"), snapshot(1, "b"));
        let pointer = Pointer { newest: newest.clone(), previous: Some(previous.clone()) };
        assert_eq!(load_order(&pointer, None, 1), Some((&newest, Some(&previous))));
        assert_eq!(load_order(&pointer, Some("b"), 1), Some((&newest, Some(&previous))));
        assert_eq!(load_order(&pointer, Some("a"), 1), Some((&previous, Some(&newest))));
        let only = Pointer { newest: newest.clone(), previous: None };
        assert_eq!(load_order(&only, Some("a"), 1), Some((&newest, None)));
    }

    #[test]
    fn a_snapshot_that_the_stream_does_not_continue_is_not_loaded() {
        let (newest, previous) = (snapshot(20, "a"), snapshot(10, "b"));
        let pointer = Pointer { newest: newest.clone(), previous: Some(previous.clone()) };
        assert_eq!(load_order(&pointer, None, 11), Some((&newest, Some(&previous))));
        assert_eq!(load_order(&pointer, Some("a"), 12), Some((&newest, None)));
        assert_eq!(load_order(&pointer, None, 21), Some((&newest, None)));
        assert_eq!(load_order(&pointer, None, 22), None);
    }
}
