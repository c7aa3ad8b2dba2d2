//! Tests a device in states that its checks normally exclude: it writes nothing wrong to memory,
//! and reports an error.

use std::sync::{Mutex, Weak};

use holdfast_memory::{
    Access, Done, Freshness, Journal, Layout, Memory, Mirrored, Read, Refusal, Refused, Span, Step,
    Term,
};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Builder;
use tokio::task::{LocalSet, spawn_local};
use tokio::time::timeout;

use super::*;
use crate::client::Place;
use crate::poller::health::Health;
use crate::poller::panic_guard::spawn_guarded;
use crate::poller::results::Receivers;
use crate::poller::write_through::Change;
use crate::poller::{BlockSettings, Destination, MirrorAge};

#[test]
fn reads_are_split_into_parts_that_fit_into_one_request() {
    let of = |area, count, limits: &PlanLimits| {
        let read = ReadSettings { area, address: 5, count, into: None, forward: true };
        let (fields, parts) = parted(&[read], limits);
        let both = fields.iter().zip(parts);
        both.map(|(field, (_, at))| (field.address, field.count, at)).collect::<Vec<_>>()
    };
    let limits = PlanLimits { max_bits: 3, max_registers: 100, ..PlanLimits::default() };
    assert_eq!(of(Area::Coils, 7, &limits), [(5, 3, 0), (8, 3, 3), (11, 1, 6)]);
    assert_eq!(of(Area::HoldingRegisters, 100, &limits), [(5, 100, 0)]);
    assert_eq!(of(Area::InputRegisters, 65_531, &PlanLimits::default()).len(), 525);
}

const TIMEOUT: Duration = Duration::from_secs(60);

/// What a device does with a read.
enum Reply {
    /// All registers are 0x0102.
    Data,
    Exception(u8),
    /// Closes the connection.
    Close,
}

/// Runs a test with a device whose registers are all 0x0102.
fn with_device<F: Future<Output = ()>>(test: impl FnOnce(Endpoint) -> F) {
    with_replies(|_, _| Reply::Data, test);
}

/// Runs a test with a device that replies to reads, by address and count.
fn with_replies<F: Future<Output = ()>>(
    reply: fn(u16, u16) -> Reply,
    test: impl FnOnce(Endpoint) -> F,
) {
    let runtime = Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&runtime, async {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        spawn_local(async move {
            while let Ok((stream, _)) = listener.accept().await {
                spawn_local(answer(stream, reply));
            }
        });
        let host = "127.0.0.1".to_owned();
        timeout(TIMEOUT, test(Place::Tcp { host, port, tls: None }.into())).await.unwrap();
    });
}

async fn answer(mut stream: TcpStream, of: fn(u16, u16) -> Reply) {
    let mut request = [0; 12];
    while stream.read_exact(&mut request).await.is_ok() {
        let address = u16::from_be_bytes([request[8], request[9]]);
        let mut reply = request[..8].to_vec();
        match of(address, request[11].into()) {
            Reply::Data => {
                let len = request[11] * 2;
                (reply[4], reply[5]) = (0, len + 3);
                reply.push(len);
                reply.extend([1, 2].repeat(usize::from(request[11])));
            }
            Reply::Exception(code) => {
                (reply[4], reply[5]) = (0, 3);
                reply[7] |= 0x80;
                reply.push(code);
            }
            Reply::Close => return,
        }
        if stream.write_all(&reply).await.is_err() {
            return;
        }
    }
}

const AREA: Area = Area::HoldingRegisters;

/// A memory with 40 holding registers.
fn memory() -> Arc<Memory> {
    let layout = Layout::default().with(AREA, Span::new(0, 40).unwrap());
    Arc::new(Memory::new(layout, None).unwrap())
}

fn registers(memory: &Memory) -> Vec<u8> {
    let mut out = vec![0; 80];
    let read = Read { area: AREA, address: 0, count: 40, out: &mut out };
    memory.read(Access::Ingest, read).unwrap();
    out
}

/// Settings that read registers 10 to 13 of the device into `address` and the registers after it.
fn settings(endpoint: Endpoint, memory: &Arc<Memory>, address: u16) -> DeviceSettings {
    let into = Some(Destination { memory: Arc::clone(memory), area: AREA, address, age: None });
    let read = ReadSettings { area: AREA, address: 10, count: 4, into, forward: true };
    let (interval, timeout) = (Duration::from_millis(1), TIMEOUT);
    DeviceSettings { interval, timeout, ..DeviceSettings::for_tests(endpoint, vec![read]) }
}

fn block(area: Area, slot: u16) -> BlockSettings {
    BlockSettings { area, slot, name: "meter".into(), keep_last_error: false }
}

fn made(mut settings: DeviceSettings, state: &Arc<DeviceState>, results: &Arc<Results>) -> Device {
    settings.report = Some(Arc::clone(results));
    let link = Link::new(settings.endpoint.clone(), settings.in_flight, settings.retry);
    let planned = Planned::new(settings).unwrap();
    let to = (link, Rc::default());
    Device::new(planned, Arc::clone(state), to, Vec::new())
}

fn device(settings: DeviceSettings) -> (Device, Arc<DeviceState>, Arc<Results>) {
    let state = Arc::<DeviceState>::default();
    let results = Receivers::default().add();
    state.set_stale_after(TIMEOUT, TIMEOUT);
    (made(settings, &state, &results), state, results)
}

#[test]
fn a_read_that_memory_refuses_is_counted_and_is_an_error() {
    with_device(async |endpoint| {
        let memory = memory();
        let (device, state, _) = device(settings(endpoint.clone(), &memory, 37));
        device.poll(Instant::now()).await;
        let counters = &state.counters;
        assert_eq!((counters.polls.get(), counters.valid.get()), (1, 1));
        assert_eq!((counters.unstored.get(), counters.reads.get()), (1, 0));
        assert_eq!((state.health(), state.last_error()), (Health::Error, 0x8006));
        assert_eq!(registers(&memory), [0; 80]);

        let (device, state, _) = self::device(settings(endpoint, &memory, 36));
        device.poll(Instant::now()).await;
        assert_eq!((state.counters.unstored.get(), state.counters.reads.get()), (0, 1));
        assert_eq!(state.health(), Health::Ok);
        assert_eq!(registers(&memory)[72..], [1, 2].repeat(4));
    });
}

thread_local! {
    static NOW: Cell<u64> = const { Cell::new(100) };
}

/// An age whose clock a test moves.
fn age() -> Arc<MirrorAge> {
    let clock = || Duration::from_secs(NOW.get());
    Arc::new(MirrorAge::new(clock, Duration::from_secs(10), false, None))
}

#[test]
fn only_the_device_of_an_age_renews_it() {
    with_device(async |endpoint| {
        let (old, new) = (age(), age());
        let memory = memory();
        let freshness = Some(Arc::clone(&new) as Arc<dyn Freshness>);
        // A reload has replaced the age, and has not reached the device yet.
        memory.mirror(vec![Mirrored { freshness, ..Mirrored::reserved(AREA, 0, 4) }]).unwrap();
        let into_of = |age: &Arc<MirrorAge>| {
            let mut settings = settings(endpoint.clone(), &memory, 0);
            settings.reads[0].into.as_mut().unwrap().age = Some(Arc::clone(age));
            device(settings).0
        };
        into_of(&old).poll(Instant::now()).await;
        assert_eq!(registers(&memory)[..8], [1, 2].repeat(4));
        assert_eq!((old.age(), new.age()), (Some(Duration::ZERO), None));
        into_of(&new).poll(Instant::now()).await;
        assert_eq!(new.age(), Some(Duration::ZERO));
    });
}

#[test]
fn a_read_of_several_requests_is_as_old_as_its_first_part() {
    let reply = |_, _| {
        NOW.set(NOW.get() + 3);
        Reply::Data
    };
    with_replies(reply, async |endpoint| {
        let age = age();
        let mut settings = settings(endpoint, &memory(), 0);
        settings.reads[0].into.as_mut().unwrap().age = Some(Arc::clone(&age));
        for (max_registers, expected) in [(2, 3), (4, 0)] {
            let limits = PlanLimits { max_registers, ..PlanLimits::default() };
            let (device, ..) = device(DeviceSettings { limits, ..settings.clone() });
            device.poll(Instant::now()).await;
            assert_eq!(age.age(), Some(Duration::from_secs(expected)));
        }
    });
}

#[test]
fn values_become_older_while_a_journal_is_slow() {
    #[derive(Debug)]
    struct Slow(Weak<Memory>);

    impl Journal for Slow {
        fn submit(&self, step: Step, done: Done) {
            NOW.set(NOW.get() + 5);
            done(step.carry_out(&[self.0.upgrade().unwrap()]));
        }
    }

    with_device(async |endpoint| {
        let (age, memory) = (age(), memory());
        memory.keep_in(Arc::new(Slow(Arc::downgrade(&memory))), 0);
        let mut settings = settings(endpoint, &memory, 0);
        settings.reads[0].into.as_mut().unwrap().age = Some(Arc::clone(&age));
        let (device, ..) = device(settings);
        device.poll(Instant::now()).await;
        assert_eq!(age.age(), Some(Duration::from_secs(5)));
    });
}

#[test]
fn a_status_block_that_memory_refuses_is_counted_and_fails_no_poll() {
    with_device(async |endpoint| {
        let memory = memory();
        for (slot, area) in [(1, AREA), (u16::MAX, AREA), (0, Area::InputRegisters)] {
            let status = StatusSettings { memory: Arc::clone(&memory), block: block(area, slot) };
            let settings =
                DeviceSettings { status: Some(status), ..settings(endpoint.clone(), &memory, 0) };
            let (device, state, _) = device(settings);
            device.publish_status();
            assert_eq!(state.counters.unstored.get(), 1);
            device.poll(Instant::now()).await;
            assert_eq!((state.health(), state.last_error()), (Health::Ok, 0));
            assert_eq!(state.counters.reads.get(), 1);
        }
        assert_eq!(registers(&memory)[8..], [0; 72]);
    });
}

/// Carries out or refuses steps when a test does.
#[derive(Default)]
struct Late {
    memory: Weak<Memory>,
    steps: Mutex<Vec<(Step, Done)>>,
}

impl std::fmt::Debug for Late {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Late")
    }
}

impl Journal for Late {
    fn submit(&self, step: Step, done: Done) {
        self.steps.lock().unwrap().push((step, done));
    }
}

impl Late {
    fn new(memory: &Arc<Memory>) -> Arc<Late> {
        let late = Arc::new(Late { memory: Arc::downgrade(memory), ..Late::default() });
        memory.keep_in(Arc::clone(&late) as Arc<dyn Journal>, 0);
        late
    }

    fn take(&self) -> Vec<(Step, Done)> {
        std::mem::take(&mut self.steps.lock().unwrap())
    }

    fn store(&self) {
        for (step, done) in self.take() {
            done(step.carry_out(&[self.memory.upgrade().unwrap()]));
        }
    }

    fn refuse(&self) {
        refuse(self.take());
    }
}

fn refuse(steps: Vec<(Step, Done)>) {
    for (_, done) in steps {
        done(Err(Refused { index: 0, refusal: Refusal::Unavailable }));
    }
}

async fn polled(device: &Device) -> Health {
    device.poll(Instant::now()).await;
    device.state.health()
}

#[test]
fn a_poll_is_in_error_for_a_late_refusal_of_its_own_lease_only() {
    with_device(async |endpoint| {
        let memory = memory();
        let journal = Late::new(&memory);
        let fence = Arc::new(Fence::new(1));
        let open = || fence.open(std::time::Instant::now() + TIMEOUT, Term::default(), TIMEOUT);
        let status = StatusSettings { memory: Arc::clone(&memory), block: block(AREA, 1) };
        let settings = DeviceSettings {
            status: Some(status),
            fence: Some(Arc::clone(&fence)),
            ..settings(endpoint, &memory, 0)
        };
        let (device, state, _) = device(settings);
        open();
        device.publish_status();
        journal.refuse();
        assert_eq!((polled(&device).await, state.counters.unstored.get()), (Health::Ok, 1));
        journal.refuse();
        assert_eq!((polled(&device).await, state.counters.unstored.get()), (Health::Error, 2));
        fence.end();
        let inbox = Inbox::default();
        tokio::select! {
            biased;
            _ = device.stand_by(&inbox) => panic!("it stands by until the fence opens"),
            () = tokio::task::yield_now() => {}
        }
        open();
        assert!(device.stand_by(&inbox).await.is_none());
        // The last read under the former lease, and two status blocks.
        journal.refuse();
        assert_eq!((polled(&device).await, state.counters.unstored.get()), (Health::Ok, 4));
    });
}

#[test]
fn polls_are_in_error_until_memory_has_stored_a_read() {
    with_device(async |endpoint| {
        let memory = memory();
        let journal = Late::new(&memory);
        let (device, state, _) = device(settings(endpoint, &memory, 0));
        let counters = &state.counters;
        let stored = || (counters.good_polls.get(), counters.reads.get(), counters.values.get());
        assert_eq!(polled(&device).await, Health::Ok, "nothing is known yet");
        polled(&device).await;
        journal.refuse();
        let before = stored();
        for failures in 1..4 {
            // Its own outcome is not known yet.
            assert_eq!(polled(&device).await, Health::Error);
            assert_eq!((state.failures(), state.last_error()), (failures, 0x8006));
        }
        assert_eq!((stored(), registers(&memory)), (before, vec![0; 80]));
        assert_eq!((before, counters.unstored.get()), ((2, 0, 0), 2));
        journal.store();
        assert_eq!((polled(&device).await, state.failures()), (Health::Ok, 0));
        assert_eq!(stored(), (3, 3, 12));
    });
}

#[test]
fn a_refusal_counts_until_a_later_read_is_stored() {
    with_device(async |endpoint| {
        let memory = memory();
        let journal = Late::new(&memory);
        let (device, ..) = device(settings(endpoint, &memory, 0));
        polled(&device).await;
        let earlier = journal.take();
        polled(&device).await;
        journal.refuse();
        journal.steps.lock().unwrap().extend(earlier);
        journal.store();
        assert_eq!(polled(&device).await, Health::Error);
        journal.store();
        assert_eq!(polled(&device).await, Health::Ok);
    });
}

#[test]
fn each_memory_that_refuses_a_read_fails_the_poll() {
    with_device(async |endpoint| {
        let (full, good) = (memory(), memory());
        let (refusing, storing) = (Late::new(&full), Late::new(&good));
        let mut settings = settings(endpoint.clone(), &full, 0);
        settings.reads.extend(self::settings(endpoint, &good, 0).reads);
        let (device, state, _) = device(settings);
        polled(&device).await;
        refusing.refuse();
        storing.store();
        assert_eq!((polled(&device).await, state.counters.reads.get()), (Health::Error, 1));
        storing.store();
        assert_eq!((polled(&device).await, state.counters.reads.get()), (Health::Error, 2));
        refusing.store();
        assert_eq!(polled(&device).await, Health::Ok);
    });
}

#[test]
fn what_memory_has_refused_is_known_after_a_reload() {
    with_device(async |endpoint| {
        let memory = memory();
        let journal = Late::new(&memory);
        let same = settings(endpoint.clone(), &memory, 0);
        let (mut device, state, results) = device(same.clone());
        polled(&device).await;
        let mut other = settings(endpoint.clone(), &memory, 20);
        other.reads.extend(same.reads.clone());
        let mut longer = same.clone();
        longer.reads[0].count += 1;
        let elsewhere = settings(endpoint.clone(), &memory, 30);
        let of_another = settings(endpoint, &self::memory(), 30);
        let expected = [
            (same, Health::Error),
            (other, Health::Error),
            (longer, Health::Error),
            (elsewhere, Health::Ok),
            (of_another, Health::Ok),
        ];
        for (settings, health) in expected {
            let mut successor = made(settings, &state, &results);
            successor.take_over(device);
            // What the device before it has read last.
            journal.refuse();
            device = successor;
            assert_eq!(polled(&device).await, health);
        }
    });
}

#[test]
fn a_device_without_a_plan_sends_nothing_and_is_in_error() {
    with_device(async |endpoint| {
        let memory = memory();
        let (mut device, state, results) = device(settings(endpoint, &memory, 0));
        assert_eq!((state.plan_error(), state.requests_per_poll()), (None, 1));
        let limits = PlanLimits { max_registers: 3, ..PlanLimits::default() };
        let before = std::mem::replace(&mut device.settings.limits, limits);
        device.draw_plan();
        let error = "read 0: field 0: 4 items, one request reads at most 3".to_owned();
        assert_eq!((state.plan_error(), state.requests_per_poll()), (Some(error), 0));

        device.poll(Instant::now()).await;
        let counters = &state.counters;
        assert_eq!((counters.unplanned.get(), counters.polls.get()), (1, 0));
        assert_eq!(counters.requests.get(), 0);
        assert_eq!((state.health(), state.last_error()), (Health::Error, 0x8005));
        let [poll] = <[Poll; 1]>::try_from(Vec::from(results.take(TIMEOUT).polls)).unwrap();
        let outcomes = poll.blocks.into_iter();
        let outcomes: Vec<_> =
            outcomes.map(|block| (block.address, block.count, block.outcome)).collect();
        assert_eq!(outcomes, [(10, 4, Err(Fault::Unplanned))]);

        device.settings.limits = before;
        device.draw_plan();
        device.poll(Instant::now()).await;
        assert_eq!((counters.unplanned.get(), counters.polls.get()), (1, 1));
        assert_eq!((state.health(), state.plan_error()), (Health::Ok, None));
    });
}

#[test]
fn a_device_that_panics_writes_nothing_and_is_in_error_until_it_is_replaced() {
    with_device(async |endpoint| {
        let memory = memory();
        let status = StatusSettings { memory: self::memory(), block: block(AREA, 0) };
        let blocks = Arc::clone(&status.memory);
        let settings = DeviceSettings { status: Some(status), ..settings(endpoint, &memory, 0) };
        let (device, state, results) = device(settings.clone());
        // The block does not contain its field.
        let block = Block { area: AREA, address: 11, count: 4, fields: vec![0], gaps: 0 };
        device.adopt(Ok(vec![block]));
        let (inbox, turn) = (Rc::new(Inbox::default()), Rc::clone(&device.turn));
        let successor = made(settings, &state, &results);
        let running = spawn_local(device.run(Duration::ZERO, Rc::clone(&inbox)));
        let status = || registers(&blocks)[..4].to_vec();
        until(|| status() == [0, 2, 0x80, 7]).await;
        assert_eq!((state.health(), state.last_error()), (Health::Error, 0x8007));
        assert_eq!((state.counters.reads.get(), registers(&memory)), (0, vec![0; 80]));
        let change = Change { area: AREA, address: 10, count: 1, bytes: vec![9, 9] };
        turn.note(change);
        assert_eq!(turn.amend(0, (AREA, 10, 1), &mut [0; 2]), 0, "no poll needs the write");

        state.set_broken(false);
        inbox.replace_with(successor);
        until(|| state.counters.polls.get() > 2 && status()[..2] == [0, 1]).await;
        assert_eq!(registers(&memory)[..8], [1, 2].repeat(4));
        running.abort();
    });
}

#[test]
fn a_task_that_panics_puts_its_device_in_error() {
    with_device(async |_| {
        let state = Arc::<DeviceState>::default();
        state.good();
        spawn_guarded(async { panic!("a fault in a forward") }, Arc::clone(&state));
        until(|| state.health() == Health::Error).await;
        state.good();
        assert_eq!((state.health(), state.last_error()), (Health::Error, 0x8007));
    });
}

/// A place that refuses connections.
fn closed_port() -> Endpoint {
    let gone = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let (host, port) = ("127.0.0.1".to_owned(), gone.local_addr().unwrap().port());
    Place::Tcp { host, port, tls: None }.into()
}

#[test]
fn an_exact_pause_ends_when_it_ends_and_not_with_the_next_interval() {
    with_device(async |_| {
        let memory = memory();
        let most = Duration::from_millis(4);
        let retry = Retry { first: Duration::from_millis(1), most, jitter: false };
        let interval = Duration::from_secs(3600);
        let settings = DeviceSettings { retry, interval, ..settings(closed_port(), &memory, 0) };
        let (device, state, _) = device(settings);
        let running = spawn_local(device.run(Duration::ZERO, Rc::default()));
        until(|| state.failures() > 3).await;
        assert_eq!((state.last_error(), state.counters.missed.get()), (0x8002, 0));
        running.abort();
    });
}

#[test]
fn a_pause_holds_without_an_interval_too() {
    with_device(async |_| {
        let pause = Duration::from_secs(3600);
        let retry = Retry { first: pause, most: pause, jitter: true };
        let settings = DeviceSettings {
            retry,
            interval: Duration::ZERO,
            ..settings(closed_port(), &memory(), 0)
        };
        let (device, state, _) = device(settings);
        let is_left_alone = || device.schedule.next() > Instant::now() + pause / 4;
        let inbox = Inbox::default();
        tokio::select! {
            _ = device.poll_until_replaced(&inbox) => {}
            () = until(|| is_left_alone() || state.failures() > 100) => {}
        }
        assert!(is_left_alone());
        assert_eq!(state.last_error(), 0x8002);
    });
}

/// Settings that read single registers, each on its own.
fn single_registers(endpoint: Endpoint, addresses: std::ops::Range<u16>) -> DeviceSettings {
    ranges(endpoint, &addresses.map(|address| (address, 1)).collect::<Vec<_>>())
}

/// The address and the count of each request of a poll.
fn planned(device: &Device) -> Vec<(u16, u16)> {
    let plan = device.plan.borrow().clone().unwrap();
    plan.iter().map(|block| (block.address, block.count)).collect()
}

#[test]
fn a_search_that_ends_while_it_joins_has_learned_and_its_device_has_answered() {
    let reply = |address, count| match (address, count) {
        // It can be read as 10 and 11, and as 12.
        (10, 3) => Reply::Close,
        (address, count) if address + count > 13 => Reply::Exception(2),
        _ => Reply::Data,
    };
    with_replies(reply, async |endpoint| {
        let retry = Retry { jitter: false, ..Retry::default() };
        let settings = DeviceSettings { retry, ..single_registers(endpoint, 10..14) };
        let (device, state, _) = device(settings);
        assert_eq!(planned(&device), [(10, 4)]);
        device.poll(Instant::now()).await;
        assert_eq!((state.counters.requests.get(), state.health()), (6, Health::Error));
        assert_eq!(planned(&device), [(10, 2), (12, 1)]);
        assert!(!device.poll_pause.is_doubtful());
    });
}

#[test]
fn a_field_that_is_refused_does_not_make_the_other_requests_longer() {
    let reply = |address, count| match (address, count) {
        (10, _) => Reply::Exception(2),
        (_, 3..) => Reply::Exception(3),
        _ => Reply::Data,
    };
    with_replies(reply, async |endpoint| {
        let long = settings(endpoint.clone(), &memory(), 0).reads;
        let mut settings = single_registers(endpoint, 20..28);
        settings.reads.extend(long);
        let (device, _, _) = device(settings);
        assert_eq!(planned(&device), [(10, 4), (20, 8)]);
        device.poll(Instant::now()).await;
        assert_eq!(planned(&device), [(20, 2), (22, 2), (24, 2), (26, 2)]);
    });
}

/// Settings that read these addresses and counts.
fn ranges(endpoint: Endpoint, ranges: &[(u16, u32)]) -> DeviceSettings {
    let reads = ranges.iter().map(|(address, count)| ReadSettings {
        area: AREA,
        address: *address,
        count: *count,
        into: None,
        forward: true,
    });
    DeviceSettings { reads: reads.collect(), ..settings(endpoint, &memory(), 0) }
}

#[test]
fn a_field_that_is_refused_does_not_cost_those_that_overlap_it() {
    let reply = |address, count| match (address, count) {
        (address, count) if address + count > 14 => Reply::Exception(2),
        _ => Reply::Data,
    };
    with_replies(reply, async |endpoint| {
        let settings = ranges(endpoint, &[(10, 2), (11, 8), (12, 1), (13, 2)]);
        let (device, state, _) = device(settings);
        assert_eq!(planned(&device), [(10, 9)]);
        device.poll(Instant::now()).await;
        assert_eq!((state.counters.reads.get(), state.last_error()), (2, 2));
        assert_eq!(planned(&device), [(10, 3)]);
        let before = state.counters.requests.get();
        device.poll(Instant::now()).await;
        assert_eq!((state.counters.reads.get(), state.counters.requests.get()), (4, before + 1));
    });
}

#[test]
fn overlapping_fields_that_no_request_reads_together_are_read_apart() {
    let reply = |_, count| if count > 3 { Reply::Exception(2) } else { Reply::Data };
    with_replies(reply, async |endpoint| {
        let (device, state, _) = device(ranges(endpoint, &[(10, 3), (12, 3)]));
        device.poll(Instant::now()).await;
        assert_eq!((state.counters.reads.get(), state.health()), (2, Health::Ok));
        assert_eq!(planned(&device), [(10, 3), (12, 3)]);
    });
}

#[test]
fn a_poll_that_was_wanted_soon_is_so_for_each_later_successor() {
    with_device(async |endpoint| {
        let settings = settings(endpoint, &memory(), 0);
        let inbox = Inbox::default();
        for at_once in [true, false, false] {
            let (successor, ..) = device(settings.clone());
            if at_once {
                successor.want_soon();
            }
            inbox.replace_with(successor);
        }
        let Message::Successor(successor) = inbox.next().await else { panic!("a successor") };
        assert!(successor.schedule.is_wanted_soon());
    });
}

/// Carries out each step at once.
#[derive(Debug)]
struct AtOnce {
    is_replicated: bool,
    memory: Weak<Memory>,
}

impl Journal for AtOnce {
    fn submit(&self, step: Step, done: Done) {
        done(step.carry_out(&[self.memory.upgrade().unwrap()]));
    }

    fn guards(&self) -> bool {
        self.is_replicated
    }
}

#[test]
fn a_device_that_stands_by_shows_it_unless_another_node_writes_the_block() {
    with_device(async |endpoint| {
        for is_replicated in [false, true] {
            let memory = memory();
            let journal = AtOnce { is_replicated, memory: Arc::downgrade(&memory) };
            memory.keep_in(Arc::new(journal), 0);
            let status = StatusSettings { memory: Arc::clone(&memory), block: block(AREA, 0) };
            let settings = settings(endpoint.clone(), &memory, 30);
            let (device, state, _) = device(DeviceSettings { status: Some(status), ..settings });
            device.poll(Instant::now()).await;
            device.publish_status();
            let shown = || u16::from_be_bytes([registers(&memory)[0], registers(&memory)[1]]);
            assert_eq!(shown(), Health::Ok.code());
            state.set_standby(true);
            device.publish_status();
            let expected = if is_replicated { Health::Ok } else { Health::Standby };
            assert_eq!(shown(), expected.code());
        }
    });
}

#[test]
fn a_device_forwards_nothing_while_another_node_has_its_lease() {
    with_device(async |endpoint| {
        let fence = Arc::new(Fence::new(1));
        let settings = settings(endpoint, &memory(), 0);
        let (mut device, ..) =
            device(DeviceSettings { fence: Some(Arc::clone(&fence)), ..settings });
        let receiver = ForwardSettings::for_tests(1, Some((1, block(AREA, 0))));
        let forward = Forward::new(receiver, Arc::default(), Some(Arc::clone(&fence)));
        device.forwards = vec![Rc::clone(&forward)];
        device.publish_status();
        assert!(!forward.has_waiting(), "the other node sends the status");
        fence.open(std::time::Instant::now() + TIMEOUT, Term::default(), Duration::ZERO);
        device.publish_status();
        assert!(forward.has_waiting());
        fence.end();
        let inbox = Inbox::default();
        tokio::select! {
            biased;
            _ = device.stand_by(&inbox) => panic!("it stands by until the fence opens"),
            () = tokio::task::yield_now() => {}
        }
        assert!(!forward.has_waiting(), "the other node sends what it reads");
    });
}

#[test]
fn seconds_in_error_begin_with_the_polls_and_end_with_a_complete_one() {
    with_device(async |_| {
        let state = DeviceState::default();
        let in_error = || state.in_error() > Duration::ZERO;
        assert!(!in_error(), "it is not polled yet");
        state.begun();
        until(in_error).await;
        let before_the_first_poll = state.in_error();
        state.bad(Fault::Timeout);
        assert!(state.in_error() >= before_the_first_poll, "a failure does not begin it anew");
        state.set_standby(true);
        assert!(!in_error(), "another node polls it");
        state.set_standby(false);
        until(in_error).await;
        state.good();
        // A device that replaces it goes on, at a reload.
        state.begun();
        assert!(!in_error());
        state.bad(Fault::Timeout);
        until(in_error).await;
    });
}

async fn until(done: impl Fn() -> bool) {
    while !done() {
        sleep(Duration::from_millis(1)).await;
    }
}
