use std::num::NonZeroU16;
use std::sync::Arc;

use holdfast_memory::{Area, Layout, Memory, Span};
use holdfast_protocol::pdu::{Range, Request};
use holdfast_protocol::raw_ingest::Format;
use holdfast_runtime::Retry;

use super::*;
use crate::client::Place;
use crate::link::InFlight;
use crate::poller::{BlockSettings, Destination, ForwardSettings, ReadSettings, StatusSettings};

const AREA: Area = Area::HoldingRegisters;

fn memory() -> Arc<Memory> {
    let layout = Layout::default().with(AREA, Span::new(10, 70).unwrap());
    Arc::new(Memory::new(layout, None).unwrap())
}

fn block(area: Area, slot: u16) -> BlockSettings {
    BlockSettings { area, slot, name: "meter".into(), keep_last_error: false }
}

fn settings() -> DeviceSettings {
    let endpoint = Place::Tcp { host: "127.0.0.1".into(), port: 502, tls: None }.into();
    let read = ReadSettings { area: AREA, address: 0, count: 4, into: None, forward: true };
    DeviceSettings::for_tests(endpoint, vec![read])
}

#[test]
fn an_address_can_be_written_in_several_ways() {
    let written =
        |host: &str| address(&Place::Tcp { host: host.into(), port: 502, tls: None }.into());
    assert_eq!(written("PLC.local"), written("plc.local"));
    assert_eq!(written("::FFFF:10.0.0.5"), written("10.0.0.5"));
    assert_eq!(written("fd00:0::1"), written("fd00::1"));
    assert_ne!(written("10.0.0.5"), written("10.0.0.50"));
    let other = Place::RtuOverTcp { host: "10.0.0.5".into(), port: 502 }.into();
    assert_ne!(written("10.0.0.5"), address(&other));
}

fn refused(change: impl FnOnce(&mut DeviceSettings)) -> String {
    let mut changed = settings();
    change(&mut changed);
    checked(changed).expect_err("the settings are invalid").to_string()
}

#[test]
fn limits_above_those_of_a_request_are_refused() {
    for limit in [0, 126, u16::MAX] {
        let expected = format!("device meter: max_registers is {limit}, allowed: 1 to 125");
        assert_eq!(refused(|device| device.limits.max_registers = limit), expected);
    }
    for limit in [0, 2001] {
        let expected = format!("device meter: max_bits is {limit}, allowed: 1 to 2000");
        assert_eq!(refused(|device| device.limits.max_bits = limit), expected);
    }
}

#[test]
fn reads_beyond_the_last_address_are_refused() {
    for (address, count) in [(0, 0), (1, 65_536), (65_535, 2), (1, u32::MAX)] {
        let expected = "device meter: read 0 has no items, or goes beyond address 65535";
        let beyond = ReadSettings { area: AREA, address, count, into: None, forward: true };
        assert_eq!(refused(|device| device.reads = vec![beyond]), expected);
    }
}

#[test]
fn a_destination_that_is_too_small_is_refused() {
    for (area, address) in [(AREA, 9), (AREA, 77), (Area::InputRegisters, 10), (Area::Coils, 10)] {
        let into = Some(Destination { memory: memory(), area, address, age: None });
        let expected = "device meter: read 0 does not fit into its destination";
        assert_eq!(refused(|device| device.reads[0].into = into), expected);
    }
    for (area, slot) in [(AREA, 0), (AREA, 2), (AREA, u16::MAX), (Area::Coils, 1)] {
        let status = Some(StatusSettings { memory: memory(), block: block(area, slot) });
        let expected = "device meter: the status block does not fit into its memory";
        assert_eq!(refused(|device| device.status = status), expected);
    }
    let forward = |offset, status: Option<BlockSettings>| ForwardSettings {
        host: "127.0.0.1".into(),
        port: 1,
        tls: None,
        format: Format::V1,
        target: 1,
        timeout: Duration::from_secs(1),
        offsets: vec![(AREA, offset)],
        status: status.map(|block| (2, block)),
    };
    let (near, far) = (forward(65_532, None), forward(65_533, None));
    let expected = "device meter: forward 1 moves read 0 beyond address 65535";
    assert_eq!(refused(|device| device.forward = vec![near.clone(), far]), expected);
    for (area, slot) in [(Area::Coils, 0), (AREA, 2184)] {
        let beyond = forward(0, Some(block(area, slot)));
        let expected = "device meter: the status block of forward 0 ends beyond address 65535";
        assert_eq!(refused(|device| device.forward = vec![beyond]), expected);
    }
    let mut fits = settings();
    fits.forward = vec![near, forward(0, Some(block(AREA, 2183)))];
    assert!(checked(fits).is_ok());
    let mut fits = settings();
    fits.reads[0].into = Some(Destination { memory: memory(), area: AREA, address: 76, age: None });
    fits.status = Some(StatusSettings { memory: memory(), block: block(AREA, 1) });
    assert!(checked(fits).is_ok());
}

#[test]
fn devices_have_the_order_in_which_they_were_added_and_a_replacement_the_place_of_the_other() {
    let named = |name: &str| DeviceSettings { name: name.into(), ..settings() };
    let poller = Poller::start(["c", "b", "a"].map(named).into()).unwrap();
    let names = || poller.devices().into_iter().map(|device| device.name).collect::<Vec<_>>();
    assert!(matches!(poller.add(named("b")), Err(PollerError::Taken { .. })));
    assert!(matches!(poller.replace("b", named("a"), false), Err(PollerError::Taken { .. })));
    assert!(matches!(poller.replace("x", named("y"), false), Err(PollerError::Unknown { .. })));
    poller.replace("b", named("d"), false).unwrap();
    poller.replace("a", named("a"), false).unwrap();
    poller.add(named("b")).unwrap();
    assert_eq!(names(), ["c", "d", "a", "b"]);
    assert!(poller.remove("c") && !poller.remove("c"));
    poller.add(named("c")).unwrap();
    assert_eq!(names(), ["d", "a", "b", "c"]);
}

fn receiver(target: u16) -> ForwardSettings {
    ForwardSettings { target, ..ForwardSettings::for_tests(1, None) }
}

#[test]
fn receivers_that_stay_keep_their_counters() {
    let with = |targets: &[u16]| {
        let forward = targets.iter().copied().map(receiver).collect();
        DeviceSettings { forward, ..settings() }
    };
    let poller = Poller::start(vec![with(&[1, 2, 2])]).unwrap();
    let counters = || poller.devices().remove(0).forwards;
    let before = counters();
    poller.replace("meter", with(&[2, 3, 2, 2]), false).unwrap();
    let now = counters();
    let kept = now.iter().map(|each| before.iter().position(|other| Arc::ptr_eq(each, other)));
    assert_eq!(kept.collect::<Vec<_>>(), [Some(1), None, Some(2), None]);
}

#[test]
fn a_receiver_that_stays_gets_what_is_waiting_for_it_and_one_that_goes_ends() {
    let runtime = Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&runtime, async {
        let with = |targets: [u16; 2]| {
            let device = DeviceSettings { forward: targets.map(receiver).into(), ..settings() };
            checked(device).unwrap()
        };
        let mut links = Links::default();
        let mut link = || links.to(&settings().endpoint, (InFlight::Fixed(1), Retry::default()));
        let (first, second) = (with([1, 2]), with([2, 3]));
        let before = Polled::new(&first.settings, 0, Arc::default());
        let mut polled = Polled::new(&second.settings, 0, Arc::clone(&before.state));
        polled.keep_forwards(&before);
        let hour = Duration::from_secs(3600);
        let mut running = RunningDevice::start(first, before, link(), hour);
        let forward = |running: &RunningDevice, at: usize| Rc::clone(&running.forwards[at].forward);
        let (goes, stays) = (forward(&running, 0), forward(&running, 1));
        let ended = running.forwards[0].task.clone();
        running.replace(second, polled, link(), false);
        assert!(Rc::ptr_eq(&forward(&running, 0), &stays));
        assert!(!Rc::ptr_eq(&forward(&running, 1), &goes));
        while !ended.is_finished() {
            tokio::task::yield_now().await;
        }
        assert!(!running.forwards[0].task.is_finished());
    });
}

#[test]
fn a_receiver_gets_nothing_that_was_read_elsewhere_before_a_reload() {
    let runtime = Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&runtime, async {
        let into = Destination { memory: memory(), area: AREA, address: 10, age: None };
        let with = |address, unit_id| {
            let mut device = DeviceSettings { unit_id, ..settings() };
            device.reads[0] =
                ReadSettings { address, into: Some(into.clone()), ..device.reads[0].clone() };
            device.forward = vec![receiver(1)];
            checked(device).unwrap()
        };
        let mut links = Links::default();
        let mut link = || links.to(&settings().endpoint, (InFlight::Fixed(1), Retry::default()));
        let (first, hour) = (with(0, 1), Duration::from_secs(3600));
        let mut polled = Polled::new(&first.settings, 0, Arc::default());
        let mut running = RunningDevice::start(first, polled.clone(), link(), hour);
        let forward = Rc::clone(&running.forwards[0].forward);
        for (address, unit_id, goes_on) in [(0, 1, true), (5, 1, false), (5, 2, false)] {
            forward.offer(AREA, 10, NonZeroU16::MIN, &[0, 7]);
            let next = with(address, unit_id);
            let before = polled;
            polled = Polled::new(&next.settings, 0, Arc::clone(&before.state));
            polled.keep_forwards(&before);
            running.replace(next, polled.clone(), link(), false);
            assert!(Rc::ptr_eq(&running.forwards[0].forward, &forward));
            assert_eq!(forward.has_waiting(), goes_on, "{address} {unit_id}");
        }
    });
}

#[test]
fn a_request_that_does_not_write_is_refused() {
    let poller = Poller::start(Vec::new()).unwrap();
    let read = Request::ReadHoldingRegisters(Range::new(0, 1).unwrap());
    let error = poller
        .write("meter", Box::new(EncodedRequest::new(&read)), None, &poller.receiver())
        .unwrap_err();
    assert_eq!(error.to_string(), "device meter: function 3 does not write");
}
