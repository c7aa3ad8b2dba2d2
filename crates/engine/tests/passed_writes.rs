//! Writes that are passed on to a device, before a memory whose journal is slow.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use holdfast_engine::client::Place;
use holdfast_engine::link::InFlight;
use holdfast_engine::poller::plan::{PlanLimits, Strategy};
use holdfast_engine::poller::{DeviceSettings, Passage, PassedRange, Poller};
use holdfast_memory::{Access, Area, Done, Journal, Layout, Memory, Read, Span, Step};
use holdfast_protocol::pdu::Request;
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

/// A device that repeats what it receives, as the reply to function 6 does.
fn device() -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut request = [0; 12];
        while stream.read_exact(&mut request).is_ok() {
            stream.write_all(&request).unwrap();
        }
    });
    address
}

/// A device without reads.
fn settings(name: &str, address: SocketAddr) -> DeviceSettings {
    let (host, port) = ("127.0.0.1".to_owned(), address.port());
    DeviceSettings {
        name: name.into(),
        endpoint: Place::Tcp { host, port, tls: None }.into(),
        in_flight: InFlight::Fixed(1),
        retry: Retry::default(),
        unit_id: 1,
        interval: Duration::from_secs(3600),
        timeout: TIMEOUT,
        reads: Vec::new(),
        limits: PlanLimits::default(),
        strategy: Strategy::Gap { max_gap: 0 },
        measured: false,
        forward: Vec::new(),
        status: None,
        start_within: Duration::ZERO,
        report: None,
        release: false,
        fence: None,
    }
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
    let devices = ["slow", "other"].map(|name| settings(name, device()));
    let poller = Poller::start(devices.to_vec()).unwrap();
    let passage = |device: &str, memory: &Arc<Memory>| {
        let range = PassedRange {
            area: AREA,
            address: 0,
            count: 10,
            device: device.into(),
            device_address: 0,
            emulate: false,
        };
        poller.passage(Arc::clone(memory), vec![range]).unwrap()
    };
    let (kept, volatile) = (memory(), memory());
    let (sender, steps) = channel();
    kept.keep_in(Arc::new(Manual(Mutex::new(sender))), 0);

    let slow = written(passage("slow", &kept));
    let Waiting(step, done) = steps.recv_timeout(TIMEOUT).expect("the journal has the write");
    let other = written(passage("other", &volatile));
    assert_eq!(other.recv_timeout(TIMEOUT), Ok(Ok(())));
    assert_eq!(register(&volatile), [0, 7]);
    assert!(slow.try_recv().is_err(), "it is not stored yet");

    done(Ok(step.carry_out(std::slice::from_ref(&kept)).unwrap()));
    assert_eq!(slow.recv_timeout(TIMEOUT), Ok(Ok(())));
    assert_eq!(register(&kept), [0, 7]);
}
