//! What a log keeps in JetStream: its stream, snapshots in an object store, and a bucket of keys that
//! names the newest snapshot and has the digests of all nodes.

use std::collections::HashMap;
use std::time::Duration;

use async_nats::Client;
use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, pull};
use async_nats::jetstream::context::{CreateStreamErrorKind, GetStreamErrorKind};
use async_nats::jetstream::object_store::{self, ObjectMetadata, ObjectStore};
use async_nats::jetstream::stream::{
    Config, DiscardPolicy, Info, RetentionPolicy, StorageType, Stream,
};
use async_nats::jetstream::{Context, ErrorCode, kv};
use base64::prelude::{BASE64_URL_SAFE, Engine};
use bytes::Bytes;
use futures_util::TryStreamExt;
use serde::{Deserialize, Serialize};
use serde_json::json;
use tokio::io::AsyncReadExt;

use crate::log::error::{End, LogError};
use crate::log::layout::difference;
use crate::log::settings::Settings;
use crate::log::state::{State, StreamPosition, digest_of};
use crate::log::stream::message::{FIRST_VERSION, MAX_NODES, VERSION};
use crate::log::stream::message_limit::MessageLimit;
use crate::log::stream::raw_message::{Received, fetch};

/// Within this time, the servers themselves notice a message that was sent twice.
const DUPLICATE_WINDOW: Duration = Duration::from_secs(120);

/// After this time without a pull, the server deletes a consumer.
const CONSUMER_TTL: Duration = Duration::from_secs(30);

/// How long the lease of the node that takes a snapshot lasts.
const LEASE_TTL: Duration = Duration::from_secs(30);

/// How long one part of a snapshot may take to arrive.
const SNAPSHOT_READ_TIMEOUT: Duration = Duration::from_secs(10);

/// A snapshot is stored in parts of so many bytes, or of as many as the servers accept in a message.
const MAX_PART_BYTES: usize = 128 << 10;

/// How many subjects of snapshots are looked at for removal at a time: each takes a request.
const MAX_REMOVALS: usize = 1000;

/// No snapshot is longer than this.
const MAX_SNAPSHOT_BYTES: u64 = 1 << 30;

/// The key that names the snapshots.
pub(in crate::log) const SNAPSHOT_KEY: &str = "snapshot";
/// The name of a node follows.
pub(in crate::log) const DIGEST_KEY_PREFIX: &str = "digest.";

/// Older releases drop the metadata of streams, and so what tells a log from another stream.
const MIN_SERVER: (u32, u32) = (2, 10);

const META_VERSION: &str = "holdfast-version";
const META_LAYOUT: &str = "holdfast-layout";
const META_ID: &str = "holdfast-id";

#[derive(Clone)]
pub(in crate::log) struct Store {
    context: Context,
    pub(in crate::log) stream: Stream,
    pub(in crate::log) keys: kv::Store,
    /// Of a node; `None` for a reader.
    leases: Option<kv::Store>,
    objects: ObjectStore,
}

/// Who opens what a log keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::log) enum OpenAs {
    /// Makes what does not exist.
    Node,
    /// Makes nothing, and needs no leases: a backup does not have them.
    Reader,
}

/// Names the snapshots of a log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::log) struct Pointer {
    pub(in crate::log) newest: Snapshot,
    pub(in crate::log) previous: Option<Snapshot>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::log) struct Snapshot {
    pub(in crate::log) sequence: u64,
    pub(in crate::log) stored: i64,
    pub(in crate::log) steps: u64,
    pub(in crate::log) object: String,
    pub(in crate::log) digest: String,
    pub(in crate::log) node: String,
    /// What the subject of its parts ends with. `None`: not stored yet, or named by a version that did not say it.
    #[serde(default)]
    pub(in crate::log) nuid: Option<String>,
}

impl Snapshot {
    /// A snapshot of this state, which is not stored yet.
    pub(in crate::log) fn of(state: &State, digest: String, node: &str) -> Snapshot {
        Snapshot {
            sequence: state.position.sequence,
            stored: state.position.stored,
            steps: state.steps,
            object: format!("{:016x}", unique() as u64),
            digest,
            node: node.to_owned(),
            nuid: None,
        }
    }
}

pub(in crate::log) fn subject(log: &str) -> String {
    format!("holdfast.log.{log}.steps")
}

fn stream_name(log: &str) -> String {
    format!("holdfast-log-{log}")
}

impl Store {
    /// Opens what the log keeps. A node makes what does not exist.
    ///
    /// The stream and its fingerprint are made in one request, and only the first one succeeds: all
    /// nodes see the same fingerprint.
    pub(in crate::log) async fn open(
        context: &Context,
        settings: &Settings,
        fingerprint: &str,
        open_as: OpenAs,
    ) -> Result<Store, End> {
        let name = stream_name(&settings.name);
        let missing = |error: &dyn std::fmt::Display| End::lost("the stream of the log", error);
        let stream = match context.get_stream(&name).await {
            Ok(stream) => stream,
            Err(error) if is_missing(&error.kind()) => {
                if open_as == OpenAs::Reader {
                    let text = format!("the servers have no log {:?}", settings.name);
                    return Err(LogError::Settings(text).into());
                }
                check_server(&context.client())?;
                match context.create_stream(config(settings, fingerprint)).await {
                    Ok(stream) => stream,
                    // Another node was first: its fingerprint is checked below.
                    Err(error) if is_taken(&error.kind()) => {
                        context.get_stream(&name).await.map_err(|error| missing(&error))?
                    }
                    Err(error) => return Err(End::lost("making the stream of the log", error)),
                }
            }
            Err(error) => return Err(missing(&error)),
        };
        check(stream.cached_info(), fingerprint, &context.client())?;
        let bucket = |suffix: &str| format!("{name}{suffix}");
        let pointers = keys(context, settings, bucket(""), Duration::ZERO, open_as).await?;
        let leases = match open_as {
            OpenAs::Node => {
                Some(keys(context, settings, bucket("-leases"), LEASE_TTL, open_as).await?)
            }
            OpenAs::Reader => None,
        };
        let objects = match context.get_object_store(bucket("")).await {
            Ok(objects) => objects,
            Err(error) if open_as == OpenAs::Reader => {
                return Err(End::lost("the snapshots of the log", error));
            }
            Err(_) => {
                let config = object_store::Config {
                    bucket: bucket(""),
                    num_replicas: settings.replicas,
                    ..object_store::Config::default()
                };
                match context.create_object_store(config).await {
                    Ok(objects) => objects,
                    // Another node may have made it at the same time.
                    Err(error) => context
                        .get_object_store(bucket(""))
                        .await
                        .map_err(|_| End::lost("making the snapshots of the log", error))?,
                }
            }
        };
        Ok(Store { context: context.clone(), stream, keys: pointers, leases, objects })
    }

    /// Whether the servers do not have the stream of the log.
    pub(in crate::log) async fn is_missing(
        context: &Context,
        settings: &Settings,
    ) -> Result<bool, End> {
        match context.get_stream(stream_name(&settings.name)).await {
            Ok(_) => Ok(false),
            Err(error) if is_missing(&error.kind()) => Ok(true),
            Err(error) => Err(End::lost("the stream of the log", error)),
        }
    }

    /// Tells the stream from another one with the same name.
    pub(in crate::log) fn id(&self) -> Option<&str> {
        self.stream.cached_info().config.metadata.get(META_ID).map(String::as_str)
    }

    /// A consumer, from this sequence on.
    pub(in crate::log) async fn consume(
        &self,
        from: u64,
        heartbeat: Duration,
    ) -> Result<pull::Stream, End> {
        let config = pull::Config {
            deliver_policy: DeliverPolicy::ByStartSequence { start_sequence: from },
            // The node itself remembers what it has applied.
            ack_policy: AckPolicy::None,
            inactive_threshold: CONSUMER_TTL,
            num_replicas: 1,
            memory_storage: true,
            ..pull::Config::default()
        };
        let lost = |error: &dyn std::fmt::Display| End::lost("reading the stream", error);
        let consumer = self.stream.create_consumer(config).await.map_err(|error| lost(&error))?;
        let pulls = consumer.stream().max_messages_per_batch(500).heartbeat(heartbeat);
        pulls.messages().await.map_err(|error| lost(&error))
    }

    /// The last sequence of the stream.
    pub(in crate::log) async fn last(&self) -> Result<u64, End> {
        let info = self.stream.get_info().await;
        Ok(info.map_err(|error| End::lost("the stream of the log", error))?.state.last_sequence)
    }

    /// On how many servers the stream is, if they say so.
    pub(in crate::log) async fn replicas(&self) -> Option<usize> {
        self.stream.get_info().await.ok().map(|info| info.config.num_replicas)
    }

    /// The message at this sequence, if the stream has it.
    pub(in crate::log) async fn message(&self, sequence: u64) -> Result<Option<Received>, End> {
        let name = &self.stream.cached_info().config.name;
        fetch(&self.context, name, json!({"seq": sequence})).await
    }

    /// Which snapshots there are, and the revision of that knowledge.
    pub(in crate::log) async fn pointer(&self) -> Result<Option<(u64, Pointer)>, End> {
        let which = json!({"last_by_subj": format!("{}{SNAPSHOT_KEY}", self.keys.prefix)});
        match fetch(&self.context, &self.keys.stream_name, which).await? {
            // A deleted key is empty.
            Some(entry) if !entry.payload.is_empty() => {
                Ok(Some((entry.position.sequence, parsed(&entry.payload)?)))
            }
            _ => Ok(None),
        }
    }

    /// Makes the key of the snapshot anew if it is missing or malformed and the stream goes on behind the
    /// snapshot; replaces it and removes digests, if a watch can't read them. Returns whether it has done so.
    /// A digest that is missing is stored again at the next comparison.
    pub(in crate::log) async fn mend_keys(&self, pointer: &Pointer) -> Result<bool, End> {
        let (stream, lost) = (&self.keys.stream_name, |error: &dyn std::fmt::Display| {
            End::lost("mending the keys", error)
        });
        let which = json!({"last_by_subj": format!("{}{SNAPSHOT_KEY}", self.keys.prefix)});
        let mut is_mended = false;
        let entry = fetch(&self.context, stream, which).await?;
        // A deleted key is empty.
        let is_there = |entry: &Received| entry.is_readable && parsed(&entry.payload).is_ok();
        let is_continued =
            pointer.newest.sequence + 1 >= self.stream.cached_info().state.first_sequence;
        if is_continued && !entry.as_ref().is_some_and(is_there) {
            let value = serde_json::to_vec(pointer).map_err(|error| lost(&error))?;
            let revision = entry.map_or(0, |entry| entry.position.sequence);
            // Fails if another node does it at the same time.
            let updated = self.keys.update(SNAPSHOT_KEY, value.into(), revision).await;
            updated.map_err(|error| lost(&error))?;
            is_mended = true;
        }
        let digests = format!("{}{DIGEST_KEY_PREFIX}>", self.keys.prefix);
        let (mut from, mut seen) = (1, 0);
        loop {
            let which = json!({"seq": from, "next_by_subj": digests});
            let Some(entry) = fetch(&self.context, stream, which).await? else { break };
            (from, seen) = (entry.position.sequence + 1, seen + 1);
            if !entry.is_readable || seen > MAX_NODES {
                let purged = self.keys.stream.purge().filter(digests).await;
                purged.map_err(|error| lost(&error))?;
                is_mended = true;
                break;
            }
        }
        Ok(is_mended)
    }

    /// Loads one of the snapshots.
    pub(in crate::log) async fn load(
        &self,
        snapshot: &Snapshot,
        state: &mut State,
    ) -> Result<(), End> {
        let position = StreamPosition { sequence: snapshot.sequence, stored: snapshot.stored };
        Ok(state.load(&self.read(snapshot).await?, position)?)
    }

    /// The bytes of a snapshot, if they have its digest.
    async fn read(&self, snapshot: &Snapshot) -> Result<Vec<u8>, End> {
        let damaged = |what: String| {
            let text = format!("the snapshot at sequence {}: {what}", snapshot.sequence);
            End::Fatal(LogError::Snapshot(text))
        };
        let missing = |error: object_store::GetError| match error.kind() {
            object_store::GetErrorKind::NotFound => damaged("it is missing".to_owned()),
            _ => End::lost("reading a snapshot", error),
        };
        let object = self.objects.get(&snapshot.object).await.map_err(missing)?;
        // Anyone may store an object of any size.
        let mut object = object.take(MAX_SNAPSHOT_BYTES);
        let mut bytes = Vec::new();
        loop {
            let read =
                tokio::time::timeout(SNAPSHOT_READ_TIMEOUT, object.read_buf(&mut bytes)).await;
            let read = read.map_err(|_| End::Lost("the snapshot does not arrive".to_owned()))?;
            if read.map_err(|error| End::lost("reading a snapshot", error))? == 0 {
                break;
            }
        }
        let digest = digest_of(&bytes);
        if digest != snapshot.digest {
            let expected = &snapshot.digest;
            return Err(damaged(format!("its digest is {digest}, expected is {expected}")));
        }
        Ok(bytes)
    }

    /// Removes the messages before this snapshot. Returns how many there were.
    ///
    /// # Errors
    /// The reason, also if the snapshot is damaged: nothing was removed then.
    pub(in crate::log) async fn make_room(&self, newest: &Snapshot) -> Result<u64, String> {
        self.read(newest).await.map_err(End::reason)?;
        let purged = self.stream.purge().sequence(newest.sequence).await;
        Ok(purged.map_err(|error| error.to_string())?.purged)
    }

    /// Whether this node may take a snapshot now.
    pub(in crate::log) async fn lease(&self, node: &str) -> Result<bool, End> {
        let Some(leases) = &self.leases else { return Ok(false) };
        let value = Bytes::copy_from_slice(node.as_bytes());
        match leases.create(SNAPSHOT_KEY, value).await {
            Ok(_) => Ok(true),
            Err(error) if error.kind() == kv::CreateErrorKind::AlreadyExists => Ok(false),
            Err(_) => self.examine().await.map(|_| false),
        }
    }

    /// What the key of the snapshots names: asked now and then, and after something has failed. `None` if the
    /// servers don't say.
    ///
    /// # Errors
    /// [`End`] if they have lost the key, or a bucket of the log.
    pub(in crate::log) async fn examine(&self) -> Result<Option<(u64, Pointer)>, End> {
        let leases = self.leases.iter().map(|leases| leases.stream_name.clone());
        let objects = self.objects_stream();
        for name in leases.chain([self.keys.stream_name.clone(), objects]) {
            match self.context.get_stream(&name).await {
                Ok(_) => {}
                Err(error) if is_missing(&error.kind()) => {
                    return Err(End::lost(&format!("the stream {name}"), error));
                }
                Err(_) => return Ok(None),
            }
        }
        match self.pointer().await {
            Ok(Some(named)) => Ok(Some(named)),
            Ok(None) => Err(End::Lost("the key of the snapshot is missing".to_owned())),
            // The next session replaces what can't be read.
            Err(End::Fatal(error)) => Err(End::Lost(error.to_string())),
            Err(_) => Ok(None),
        }
    }

    /// The name of the stream with the snapshots.
    fn objects_stream(&self) -> String {
        format!("OBJ_{}", self.stream.cached_info().config.name)
    }

    pub(in crate::log) async fn release(&self) {
        if let Some(leases) = &self.leases {
            // Otherwise it expires.
            let _ = leases.delete(SNAPSHOT_KEY).await;
        }
    }

    /// Stores a snapshot and names it the newest, if the newest is still the one of `seen`.
    pub(in crate::log) async fn put(
        &self,
        limit: &MessageLimit,
        seen: Option<(u64, Pointer)>,
        encoded: &[u8],
        mut snapshot: Snapshot,
    ) -> Result<(u64, Pointer), String> {
        snapshot.object = format!("{}-{}-{}", snapshot.sequence, snapshot.node, snapshot.object);
        let part = MAX_PART_BYTES.min(limit.bytes());
        limit.sent(part.min(encoded.len()));
        let object = ObjectMetadata {
            name: snapshot.object.clone(),
            chunk_size: Some(part),
            ..ObjectMetadata::default()
        };
        let mut bytes = encoded;
        match self.objects.put(object, &mut bytes).await {
            Ok(object) => snapshot.nuid = Some(object.nuid),
            Err(error) => {
                // The servers may have no room, of which the parts that have arrived take some: they are removed. If
                // this fails as well, the next snapshot removes them.
                if let Some((revision, pointer)) = seen {
                    let _ = self.name(Some(revision), &pointer).await;
                }
                return Err(error.to_string());
            }
        }
        let (revision, previous) =
            seen.map(|(at, of)| (Some(at), Some(of.newest))).unwrap_or_default();
        let pointer = Pointer { newest: snapshot, previous };
        let revision = self.name(revision, &pointer).await?;
        Ok((revision, pointer))
    }

    /// Names the snapshots in the key, if the key is still of this revision. Removes the messages older than them, and
    /// all other snapshots and their parts. Returns the new revision.
    async fn name(&self, seen: Option<u64>, pointer: &Pointer) -> Result<u64, String> {
        let bucket = &self.stream.cached_info().config.name;
        let objects = self.context.get_stream_no_info(self.objects_stream()).await;
        let objects = objects.map_err(|error| error.to_string())?;
        // Before the key changes: a node that has stored one of these, and not named it by then, can't name it any
        // more, as its own change of the key expects the former revision.
        let stored = objects.info_with_subjects(format!("$O.{bucket}.>")).await;
        let stored = stored.map_err(|error| error.to_string())?.try_collect::<Vec<_>>().await;
        let mut stored = stored.map_err(|error| error.to_string())?;
        // The name of an object before its parts: who reads it meanwhile finds it missing, not damaged.
        stored.sort_unstable_by(|one, other| other.cmp(one));
        let value = Bytes::from(serde_json::to_vec(pointer).map_err(|error| error.to_string())?);
        let revision = match seen {
            None => self.keys.create(SNAPSHOT_KEY, value).await.map_err(|error| error.to_string()),
            Some(at) => {
                self.keys.update(SNAPSHOT_KEY, value, at).await.map_err(|error| error.to_string())
            }
        }?;
        // The last snapshot may turn out to be damaged: the one before it can still be continued.
        if let Some(previous) = &pointer.previous
            && previous.sequence > 1
        {
            let purge = self.stream.purge().sequence(previous.sequence);
            purge.await.map_err(|error| error.to_string())?;
        }
        let mut named = Vec::new();
        for snapshot in [Some(&pointer.newest), pointer.previous.as_ref()].into_iter().flatten() {
            // A version that did not say it has named this one: its parts can't be told from others.
            let Some(nuid) = &snapshot.nuid else { return Ok(revision) };
            named.push(format!("$O.{bucket}.C.{nuid}"));
            named.push(format!("$O.{bucket}.M.{}", BASE64_URL_SAFE.encode(&snapshot.object)));
        }
        // Earlier releases left a marker of each snapshot: the next snapshots remove the rest.
        for (subject, _) in stored.into_iter().take(MAX_REMOVALS) {
            // Those of somebody else may have wildcards.
            if !named.contains(&subject) && !subject.contains(['*', '>']) {
                objects.purge().filter(subject).await.map_err(|error| error.to_string())?;
            }
        }
        Ok(revision)
    }
}

pub(in crate::log) fn parsed(pointer: &[u8]) -> Result<Pointer, LogError> {
    serde_json::from_slice(pointer)
        .map_err(|error| LogError::Snapshot(format!("the key of the snapshot: {error}")))
}

fn config(settings: &Settings, fingerprint: &str) -> Config {
    let id = format!("{:032x}", unique());
    let metadata = [
        (META_VERSION, FIRST_VERSION.to_string()),
        (META_LAYOUT, fingerprint.to_owned()),
        (META_ID, id),
    ];
    Config {
        name: stream_name(&settings.name),
        description: Some("Writes to memories of Holdfast, in their order".to_owned()),
        subjects: vec![subject(&settings.name)],
        storage: StorageType::File,
        retention: RetentionPolicy::Limits,
        // Without limits. If a server sets one, a full stream refuses messages: it must not drop the oldest,
        // which nodes have not applied yet.
        max_messages: -1,
        max_bytes: -1,
        max_messages_per_subject: -1,
        discard: DiscardPolicy::New,
        num_replicas: settings.replicas,
        duplicate_window: DUPLICATE_WINDOW,
        deny_delete: true,
        metadata: metadata.map(|(key, value)| (key.to_owned(), value)).into(),
        ..Config::default()
    }
}

/// A number that no other process has drawn.
pub(in crate::log) fn unique() -> u128 {
    let mut bytes = [0; 16];
    aws_lc_rs::rand::fill(&mut bytes).expect("the system has random numbers");
    u128::from_le_bytes(bytes)
}

fn is_missing(kind: &GetStreamErrorKind) -> bool {
    matches!(kind, GetStreamErrorKind::JetStream(error)
        if error.error_code() == ErrorCode::STREAM_NOT_FOUND)
}

fn is_taken(kind: &CreateStreamErrorKind) -> bool {
    matches!(kind, CreateStreamErrorKind::JetStream(error)
        if error.error_code() == ErrorCode::STREAM_NAME_EXIST)
}

/// Refuses a server that is known to be too old. A version of another form is not judged.
fn check_server(client: &Client) -> Result<(), LogError> {
    let found = client.server_info().version;
    let mut parts = found.split('.').map(str::parse::<u32>);
    let (Some(Ok(major)), Some(Ok(minor))) = (parts.next(), parts.next()) else { return Ok(()) };
    if (major, minor) >= MIN_SERVER {
        return Ok(());
    }
    let (major, minor) = MIN_SERVER;
    let text =
        format!("the server is nats-server {found}: a log requires {major}.{minor} or newer");
    Err(LogError::Settings(text))
}

/// Checks that a stream is of this version and layout.
fn check(info: &Info, fingerprint: &str, client: &Client) -> Result<(), LogError> {
    let metadata: &HashMap<String, String> = &info.config.metadata;
    let (Some(version), Some(layout), Some(_)) =
        (metadata.get(META_VERSION), metadata.get(META_LAYOUT), metadata.get(META_ID))
    else {
        check_server(client)?;
        let text = format!("stream {} is not that of a log: delete it", info.config.name);
        return Err(LogError::Settings(text));
    };
    let found = version.parse().unwrap_or(u8::MAX);
    if !(FIRST_VERSION..=VERSION).contains(&found) {
        return Err(LogError::Version { what: "the log", found, supported: VERSION });
    }
    difference(layout, fingerprint).map_or(Ok(()), |difference| Err(LogError::Layout(difference)))
}

async fn keys(
    context: &Context,
    settings: &Settings,
    bucket: String,
    max_age: Duration,
    open_as: OpenAs,
) -> Result<kv::Store, End> {
    let lost = |error: &dyn std::fmt::Display| End::lost("the keys of the log", error);
    match context.get_key_value(&bucket).await {
        Ok(keys) => Ok(keys),
        Err(error) if open_as == OpenAs::Reader => Err(lost(&error)),
        Err(_) => {
            let config = kv::Config {
                bucket: bucket.clone(),
                history: 1,
                max_age,
                storage: StorageType::File,
                num_replicas: settings.replicas,
                ..kv::Config::default()
            };
            match context.create_key_value(config).await {
                Ok(keys) => Ok(keys),
                // Another node may have made it at the same time.
                Err(error) => context
                    .get_key_value(&bucket)
                    .await
                    .map_err(|_| End::lost("making the keys of the log", error)),
            }
        }
    }
}
