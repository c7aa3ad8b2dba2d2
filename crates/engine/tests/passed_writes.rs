//! Writes that are passed on to a device: before a memory whose journal is slow, during a reload, and after a standstill.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use holdfast_engine::client::{Peers, Place};
use holdfast_engine::link::{Caller, Fault, InFlight, LinkSettings};
use holdfast_engine::poller::plan::{PlanLimits, Strategy};
use holdfast_engine::poller::{
    Destination, DeviceSettings, Passage, PassedRange, Poller, ReadSettings, Written,
};
use holdfast_memory::{Access, Area, Done, Journal, Layout, Memory, Read, Span, Step};
use holdfast_protocol::client::MAX_READ_DELAY;
use holdfast_protocol::pdu::{EncodedRequest, Range, Request};
use holdfast_runtime::Retry;

const AREA: Area = Area::HoldingRegisters;
const TIMEOUT: Duration = Duration::from_secs(60);

/// Hands all steps to the test.
#[derive(Debug)]
struct Manual(Mutex<Sender<Waiting>>);

struct Waiting(Step, Done);

impl Journal for Manual {
    fn submit(&self, step: Step, done: Done) {
        self.0.lock().unwrap().send(Waiting(step, done)).unwrap();
    }
}

fn memory() -> Arc<Memory> {
    let layout = Layout::default().with(AREA, Span::new(0, 10).unwrap());
    Arc::new(Memory::new(layout, None).unwrap())
}

fn register(memory: &Memory) -> [u8; 2] {
    let mut out = [0; 2];
    let read = Read { area: AREA, address: 3, count: 1, out: &mut out };
    memory.read(Access::Ingest, read).unwrap();
    out
}

/// Two units. The first keeps what is written to register 3; all other registers are 0. `before_write` is
/// called before function 6 is answered.
fn device(before_write: impl Fn() + Send + 'static) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let (mut request, mut value) = ([0; 12], [0; 2]);
        while stream.read_exact(&mut request).is_ok() {
            if request[7] == 6 {
                before_write();
                value.copy_from_slice(&request[10..]);
                stream.write_all(&request).unwrap();
            } else {
                let [high, low, .., unit_id, _, _, _, _, _] = request;
                let mut reply = [0; 19];
                reply[..9].copy_from_slice(&[high, low, 0, 0, 0, 13, unit_id, 3, 10]);
                if unit_id == 1 {
                    reply[15..17].copy_from_slice(&value);
                }
                stream.write_all(&reply).unwrap();
            }
        }
    });
    address
}

/// A device that is read into the start of a memory.
fn settings(name: &str, address: SocketAddr, memory: &Arc<Memory>) -> DeviceSettings {
    let (host, port) = ("127.0.0.1".to_owned(), address.port());
    DeviceSettings {
        name: name.into(),
        endpoint: Place::Tcp { host, port, tls: None }.into(),
        in_flight: InFlight::Fixed(1),
        retry: Retry::default(),
        unit_id: 1,
        interval: Duration::from_secs(3600),
        timeout: TIMEOUT,
        reads: vec![ReadSettings {
            area: AREA,
            address: 0,
            count: 5,
            into: Some(Destination {
                memory: Arc::clone(memory),
                area: AREA,
                address: 0,
                age: None,
            }),
            forward: false,
        }],
        limits: PlanLimits::default(),
        strategy: Strategy::Gap { max_gap: 0 },
        measured: false,
        forward: Vec::new(),
        status: None,
        start_within: Duration::ZERO,
        report: None,
        reported_as: None,
        release: false,
        fence: None,
    }
}

/// Passes writes into the start of a memory on to a device.
fn passage(poller: &Poller, device: &str, memory: &Arc<Memory>) -> Passage {
    let range = PassedRange {
        area: AREA,
        address: 0,
        count: 5,
        device: device.into(),
        device_address: 0,
        emulate: false,
    };
    poller.passage(Arc::clone(memory), vec![range]).unwrap()
}

/// Writes register 3 in a thread of its own.
fn written(passage: Passage) -> Receiver<Result<(), u8>> {
    let (sender, outcome) = channel();
    thread::spawn(move || {
        let request = Request::WriteSingleRegister { address: 3, value: 7 };
        sender.send(passage.write(&request)).unwrap();
    });
    outcome
}

#[test]
fn a_journal_that_is_slow_holds_up_no_other_device() {
    let (kept, volatile) = (memory(), memory());
    let (sender, steps) = channel();
    kept.keep_in(Arc::new(Manual(Mutex::new(sender))), 0);
    let slow = settings("slow", device(|| ()), &kept);
    let other = settings("other", device(|| ()), &volatile);
    let poller = Poller::start(vec![slow, other]).unwrap();
    let carry_out = |Waiting(step, done): Waiting| {
        done(Ok(step.carry_out(std::slice::from_ref(&kept)).unwrap()));
    };
    carry_out(steps.recv_timeout(TIMEOUT).expect("the journal has the first poll"));

    let slow = written(passage(&poller, "slow", &kept));
    let step = steps.recv_timeout(TIMEOUT).expect("the journal has the write");
    let other = written(passage(&poller, "other", &volatile));
    assert_eq!(other.recv_timeout(TIMEOUT), Ok(Ok(())));
    assert_eq!(register(&volatile), [0, 7]);
    assert!(slow.try_recv().is_err(), "it is not stored yet");

    carry_out(step);
    assert_eq!(slow.recv_timeout(TIMEOUT), Ok(Ok(())));
    assert_eq!(register(&kept), [0, 7]);
}

/// The outcome of a write, and what memory has then: the settings of its device change while it is under way.
fn written_beside(change: impl FnOnce(&Poller, DeviceSettings)) -> (Result<(), u8>, [u8; 2]) {
    let memory = memory();
    let (sender, asked) = channel();
    let (answers, answer) = channel();
    let address = device(move || {
        sender.send(()).unwrap();
        answer.recv_timeout(TIMEOUT).unwrap();
    });
    let settings = settings("meter", address, &memory);
    let poller = Poller::start(vec![settings.clone()]).unwrap();
    let outcome = written(passage(&poller, "meter", &memory));
    asked.recv_timeout(TIMEOUT).expect("the device has the write");

    change(&poller, settings);
    // It is refused after the thread of the poller has made the change.
    let unknown = passage(&poller, "unknown", &memory);
    assert_eq!(written(unknown).recv_timeout(TIMEOUT), Ok(Err(0x0A)));
    answers.send(()).unwrap();
    (outcome.recv_timeout(TIMEOUT).unwrap(), register(&memory))
}

#[test]
fn a_write_is_not_stored_where_its_device_is_no_longer_read_into() {
    let not_stored = (Err(0x0B), [0, 0]);
    let beside = written_beside(|poller, mut settings| {
        settings.reads[0].into.as_mut().unwrap().address = 5;
        poller.replace("meter", settings, false).unwrap();
    });
    assert_eq!(beside, not_stored);
    let beside = written_beside(|poller, mut settings| {
        settings.unit_id = 2;
        poller.replace("meter", settings, false).unwrap();
    });
    assert_eq!(beside, not_stored);
    assert_eq!(written_beside(|poller, _| assert!(poller.remove("meter"))), not_stored);
}

#[test]
fn a_write_is_stored_where_its_device_is_read_into_with_more_registers() {
    let beside = written_beside(|poller, mut settings| {
        settings.reads[0].count = 8;
        poller.replace("meter", settings, false).unwrap();
    });
    assert_eq!(beside, (Ok(()), [0, 7]));
}

#[test]
fn a_write_to_a_range_that_has_moved_is_not_sent() {
    let memory = memory();
    let settings = settings("meter", device(|| panic!("it was sent")), &memory);
    let poller = Poller::start(vec![settings.clone()]).unwrap();
    let before = passage(&poller, "meter", &memory);
    let mut moved = settings;
    moved.reads[0].into.as_mut().unwrap().address = 5;
    poller.replace("meter", moved, false).unwrap();
    assert_eq!(written(before).recv_timeout(TIMEOUT), Ok(Err(0x0A)));
}

/// Hands all steps to the test, and keeps the thread that submits one until the test goes on.
#[derive(Debug)]
struct Holding(Manual, Mutex<Receiver<()>>);

impl Journal for Holding {
    fn submit(&self, step: Step, done: Done) {
        self.0.submit(step, done);
        self.1.lock().unwrap().recv_timeout(TIMEOUT).unwrap();
    }
}

#[test]
fn a_write_that_waits_through_a_standstill_is_not_sent() {
    let memory = memory();
    let ((sender, steps), (goes_on, held)) = (channel(), channel());
    memory.keep_in(Arc::new(Holding(Manual(Mutex::new(sender)), Mutex::new(held))), 0);
    let submitted = || steps.recv_timeout(TIMEOUT).expect("the journal has a step");
    let carry_out = |Waiting(step, done): Waiting, time: Duration| {
        let began = Instant::now();
        while began.elapsed() < time {
            thread::yield_now();
        }
        done(Ok(step.carry_out(std::slice::from_ref(&memory)).unwrap()));
        goes_on.send(()).unwrap();
    };
    let (asks, asked) = channel();
    let (answers, answer) = channel();
    let address = device(move || {
        asks.send(()).unwrap();
        answer.recv_timeout(TIMEOUT).unwrap();
    });
    let settings = settings("meter", address, &memory);
    let poller = Poller::start(vec![settings.clone()]).unwrap();
    carry_out(submitted(), Duration::ZERO);

    let passage = passage(&poller, "meter", &memory);
    let link = poller.link(LinkSettings {
        endpoint: settings.endpoint,
        in_flight: settings.in_flight,
        retry: settings.retry,
        queue: LinkSettings::QUEUE,
        coalesce: true,
        cache: Duration::ZERO,
        preferred: Vec::new(),
    });
    let link = link.unwrap();
    let (caller, _wakes) = Caller::new().unwrap();
    let write = Request::WriteSingleRegister { address: 3, value: 7 };
    let read = Request::ReadHoldingRegisters(Range::new(0, 5).unwrap());
    let call = |request: &Request<'_>| {
        link.call(&caller, 1, &EncodedRequest::new(request), TIMEOUT, false, Peers::default())
            .unwrap()
    };
    let sent = passage.call(&caller, &write);
    asked.recv_timeout(TIMEOUT).expect("the device has the write");
    let waiting = [passage.call(&caller, &write), call(&write), call(&read)];
    answers.send(()).unwrap();
    // The thread of the poller waits for its journal.
    let step = submitted();
    let results = poller.receiver();
    let of_tag = poller.write("meter", Box::new(EncodedRequest::new(&write)), None, &results);
    carry_out(step, MAX_READ_DELAY * 3 / 2);

    let began = Instant::now();
    let mut ended = Vec::new();
    while ended.len() < 4 {
        assert!(began.elapsed() < TIMEOUT, "{ended:?}");
        ended.extend(caller.take());
        thread::yield_now();
    }
    let outcome = |ticket| {
        let call = ended.iter().find(|call| call.ticket == ticket).unwrap();
        let error = call.outcome.as_ref().err().map(ToString::to_string);
        (call.is_sent, error.as_deref().unwrap_or("done").to_owned())
    };
    assert_eq!(outcome(sent), (true, "done".into()));
    assert_eq!(outcome(waiting[0]), (false, "exception 0x0a".into()));
    assert_eq!(outcome(waiting[1]), (false, "not sent: it has waited too long".into()));
    assert_eq!(outcome(waiting[2]), (true, "done".into()), "a read");
    assert_eq!(link.counters.withdrawn.get(), 1);
    let of_tag = Written { ticket: of_tag.unwrap(), outcome: Err(Fault::Expired) };
    let mut written = Vec::new();
    while written.is_empty() {
        assert!(began.elapsed() < TIMEOUT, "the tag has no result");
        written = results.take(TIMEOUT).writes;
    }
    assert_eq!(written, [of_tag]);
    assert!(asked.try_recv().is_err(), "the device has another write");
}
