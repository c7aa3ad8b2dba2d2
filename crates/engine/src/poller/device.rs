//! One device: its schedule, its plan, and what it has to tell.
//!
//! The schedule does not drift: polls are due at whole intervals from the start. One that can't begin
//! in time is skipped and counted, not caught up. A unit that stays silent is asked less and less
//! often, with one request, until it answers.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::rc::Rc;
use std::sync::atomic::{AtomicU16, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use holdfast_memory::Area;
use holdfast_protocol::pdu::{self, Range, Request};
use tokio::time::{Instant, sleep_until};

use super::backoff;
use super::forward::{Forward, ForwardSettings};
use super::link::Link;
use super::plan::{self, Block, Field, Limits, Strategy};
use super::results::{BlockResult, Poll, Results};
use super::sink::Destination;
use super::status::{Fault, Health, Status, StatusSettings};
use crate::client::Endpoint;
use crate::counters::Counter;

/// Exceptions that speak of what was asked for, not of the device.
const ILLEGAL: [u8; 2] = [2, ILLEGAL_VALUE];
const ILLEGAL_VALUE: u8 = 3;

/// Timeouts in a row after which a unit is held to be dead.
const DEAD_AFTER: u32 = 3;

/// How long a refused plan is remembered before the first one is tried again.
const REMEMBERED: Duration = Duration::from_secs(600);

/// A device and what is to become of what it answers.
#[derive(Debug, Clone)]
pub struct DeviceSettings {
    pub name: String,
    pub endpoint: Endpoint,
    pub unit_id: u8,
    /// 0 polls without a pause.
    pub interval: Duration,
    pub timeout: Duration,
    pub reads: Vec<ReadSettings>,
    pub limits: Limits,
    pub strategy: Strategy,
    pub forward: Vec<ForwardSettings>,
    pub status: Option<StatusSettings>,
    /// The first poll comes within this time, at a moment that differs from device to device.
    pub start_within: Duration,
    /// Whether what is read goes to [`super::Results`] too.
    pub report: bool,
    /// Whether the connection is closed after each poll, for devices that have only one.
    pub release: bool,
}

#[derive(Debug, Clone)]
pub struct ReadSettings {
    pub area: Area,
    pub address: u16,
    /// Any number: what does not fit into one request takes several, and is written as one step.
    pub count: u32,
    pub into: Option<Destination>,
}

/// What a device counted, and how it does: read from any thread.
#[derive(Debug, Default)]
pub struct DeviceState {
    pub counters: DeviceCounters,
    health: AtomicU16,
    last_error: AtomicU16,
    failures: AtomicU32,
    most_failures: AtomicU32,
    /// Microseconds of the last answer.
    round_trip: AtomicU64,
    requests_per_poll: AtomicU32,
    since: Mutex<Times>,
}

#[derive(Debug, Default)]
struct Times {
    last_good: Option<std::time::Instant>,
    error_since: Option<std::time::Instant>,
}

#[derive(Debug, Default)]
pub struct DeviceCounters {
    pub requests: Counter,
    pub valid: Counter,
    pub exceptions: Counter,
    pub timeouts: Counter,
    pub transport_errors: Counter,
    /// Polls that were carried out.
    pub polls: Counter,
    /// Polls that could not begin in time.
    pub missed: Counter,
    /// Reads that were written, and values in them.
    pub reads: Counter,
    pub values: Counter,
}

impl DeviceState {
    pub fn health(&self) -> Health {
        match self.health.load(Ordering::Relaxed) {
            1 => Health::Ok,
            2 => Health::Error,
            3 => Health::Stale,
            _ => Health::Unknown,
        }
    }

    /// As the status block tells it: an exception code, or 0x8000 and a class.
    pub fn last_error(&self) -> u16 {
        self.last_error.load(Ordering::Relaxed)
    }

    pub fn failures(&self) -> u32 {
        self.failures.load(Ordering::Relaxed)
    }

    pub fn round_trip(&self) -> Duration {
        Duration::from_micros(self.round_trip.load(Ordering::Relaxed))
    }

    pub fn requests_per_poll(&self) -> u32 {
        self.requests_per_poll.load(Ordering::Relaxed)
    }

    /// How long ago the last valid answer came.
    pub fn age(&self) -> Option<Duration> {
        self.times().last_good.map(|time| time.elapsed())
    }

    pub fn in_error(&self) -> Duration {
        self.times().error_since.map_or(Duration::ZERO, |time| time.elapsed())
    }

    fn times(&self) -> std::sync::MutexGuard<'_, Times> {
        self.since.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn good(&self, health: Health) {
        let mut times = self.times();
        times.last_good = Some(std::time::Instant::now());
        times.error_since = None;
        self.failures.store(0, Ordering::Relaxed);
        self.health.store(health.code(), Ordering::Relaxed);
    }

    fn bad(&self, fault: Fault) {
        self.times().error_since.get_or_insert_with(std::time::Instant::now);
        self.health.store(Health::Error.code(), Ordering::Relaxed);
        self.last_error.store(fault.code(), Ordering::Relaxed);
        let failures = self.failures.fetch_add(1, Ordering::Relaxed) + 1;
        self.most_failures.fetch_max(failures, Ordering::Relaxed);
    }

    fn status(&self) -> Status {
        let counters = &self.counters;
        Status {
            health: self.health(),
            last_error: self.last_error(),
            seconds_in_error: saturated(self.in_error().as_secs()),
            requests: counters.requests.get() as u32,
            valid: counters.valid.get() as u32,
            timeouts: counters.timeouts.get() as u32,
            transport_errors: counters.transport_errors.get() as u32,
            failures: saturated(self.failures().into()),
            most_failures: saturated(self.most_failures.load(Ordering::Relaxed).into()),
        }
    }
}

fn saturated(number: u64) -> u16 {
    u16::try_from(number).unwrap_or(u16::MAX)
}

/// A device that is polled.
pub(super) struct Device {
    settings: DeviceSettings,
    state: Arc<DeviceState>,
    link: Rc<Link>,
    forwards: Vec<Rc<Forward>>,
    /// The parts of reads that one request can carry.
    fields: Vec<Field>,
    /// The read that each field is a part of, and its place in it, in items.
    parts: Vec<(usize, u32)>,
    report: Option<Arc<Results>>,
    name: Arc<str>,
    limits: RefCell<Limits>,
    plan: RefCell<Rc<Vec<Block>>>,
    /// When the first plan is tried again.
    revise: Cell<Option<Instant>>,
    silent: Cell<u32>,
}

/// The fields of reads, each no longer than a request.
pub(super) fn fields(reads: &[ReadSettings], limits: &Limits) -> Vec<(Field, usize, u32)> {
    let mut fields = Vec::new();
    for (index, read) in reads.iter().enumerate() {
        let most =
            u32::from(if read.area.is_bits() { limits.max_bits } else { limits.max_registers });
        // Parts of bits begin at whole bytes, so that they are put together by copying.
        let step = if read.area.is_bits() { (most & !7).max(8) } else { most.max(1) };
        let mut at = 0;
        while at < read.count {
            let count = step.min(read.count - at);
            let address = (u32::from(read.address) + at) as u16;
            fields.push((Field { area: read.area, address, count: count as u16 }, index, at));
            at += count;
        }
    }
    fields
}

impl Device {
    pub(super) fn new(
        settings: DeviceSettings,
        state: Arc<DeviceState>,
        link: Rc<Link>,
        forwards: Vec<Rc<Forward>>,
        report: Option<Arc<Results>>,
    ) -> Device {
        let parted = fields(&settings.reads, &settings.limits);
        let device = Device {
            fields: parted.iter().map(|(field, ..)| *field).collect(),
            parts: parted.iter().map(|(_, read, at)| (*read, *at)).collect(),
            report,
            name: settings.name.as_str().into(),
            limits: RefCell::new(settings.limits.clone()),
            plan: RefCell::default(),
            revise: Cell::new(None),
            silent: Cell::new(0),
            settings,
            state,
            link,
            forwards,
        };
        device.draw_plan();
        device
    }

    /// Polls for ever, first after `phase`.
    pub(super) async fn run(self, phase: Duration) {
        let start = Instant::now() + phase;
        let interval = self.settings.interval;
        let mut due = 0;
        self.tell();
        loop {
            let at = start + interval.saturating_mul(due);
            sleep_until(at).await;
            self.poll().await;
            self.tell();
            if interval.is_zero() {
                tokio::task::yield_now().await;
                continue;
            }
            let passed = (start.elapsed().as_nanos() / interval.as_nanos()) as u32;
            let next = (due + 1).max(passed + u32::from(start.elapsed() > interval * passed));
            for _ in due + 1..next {
                self.state.counters.missed.add();
            }
            due = next;
            if let Some(pause) = self.pause() {
                let until = Instant::now() + pause;
                self.wait_and_tell(until).await;
                let passed = (start.elapsed().as_nanos() / interval.as_nanos()) as u32;
                due = due.max(passed + 1);
            }
        }
    }

    /// How long a dead unit is left alone.
    fn pause(&self) -> Option<Duration> {
        let silent = self.silent.get();
        (silent >= DEAD_AFTER).then(|| backoff::pause(silent - DEAD_AFTER + 1))
    }

    /// Keeps the age in the status block true while nothing is asked.
    async fn wait_and_tell(&self, until: Instant) {
        while Instant::now() < until {
            sleep_until(until.min(Instant::now() + Duration::from_secs(1))).await;
            self.tell();
        }
    }

    fn draw_plan(&self) {
        // That every field can be read was checked when the poller was made.
        let plan = plan::plan(&self.fields, &self.limits.borrow(), self.settings.strategy);
        *self.plan.borrow_mut() = Rc::new(plan.unwrap_or_default());
        self.note_plan();
    }

    fn note_plan(&self) {
        let requests = self.plan.borrow().len() as u32;
        self.state.requests_per_poll.store(requests, Ordering::Relaxed);
    }

    /// Reads every block, and hands on every read that came whole.
    async fn poll(&self) {
        if self.revise.get().is_some_and(|time| Instant::now() >= time) {
            self.revise.set(None);
            self.limits.replace(self.settings.limits.clone());
            self.draw_plan();
        }
        self.state.counters.polls.add();
        let mut gathered = Gathered { report: self.report.is_some(), ..Gathered::default() };
        let (mut fault, mut answered) = (None, false);
        let plan = Rc::clone(&self.plan.borrow());
        for block in plan.iter() {
            match self.read(block, &mut gathered).await {
                Ok(()) => answered = true,
                Err(refused @ Fault::Exception(_)) => {
                    answered = true;
                    fault = Some(refused);
                }
                Err(other) => {
                    fault = Some(other);
                    // What one request did not bring, the next would not bring either.
                    break;
                }
            }
        }
        if let Some(results) = &self.report {
            let (device, blocks) = (Arc::clone(&self.name), gathered.blocks);
            results.push(Poll { device, time: SystemTime::now(), blocks });
        }
        if self.settings.release {
            self.link.release();
        }
        match (fault, answered) {
            (Some(Fault::Timeout | Fault::Refused | Fault::Reset), false) => {
                self.silent.set(self.silent.get().saturating_add(1));
            }
            _ => self.silent.set(0),
        }
        match fault {
            None => self.state.good(self.punctual()),
            Some(fault) => self.state.bad(fault),
        }
    }

    /// Reads a block, or what becomes of it when the device refuses: smaller ones, until a bad field
    /// is alone.
    async fn read(&self, block: &Block, gathered: &mut Gathered) -> Result<(), Fault> {
        let bytes = match self.ask(block).await {
            Ok(bytes) => bytes,
            Err(Fault::Exception(code)) if ILLEGAL.contains(&code) => {
                let smaller = plan::smaller(&self.fields, block);
                if smaller.is_empty() {
                    gathered.note(block, Err(Fault::Exception(code)));
                    return Err(Fault::Exception(code));
                }
                if code == ILLEGAL_VALUE {
                    self.lower_limit(block);
                }
                self.replace(block, &smaller);
                let mut done = Ok(());
                for part in &smaller {
                    match Box::pin(self.read(part, gathered)).await {
                        Ok(()) => {}
                        Err(refused @ Fault::Exception(_)) => done = Err(refused),
                        Err(other) => return Err(other),
                    }
                }
                return done;
            }
            Err(other) => {
                gathered.note(block, Err(other));
                return Err(other);
            }
        };
        self.spread(block, &bytes, gathered);
        gathered.note(block, Ok(bytes));
        Ok(())
    }

    /// Answers that come later than three intervals are out of date.
    fn punctual(&self) -> Health {
        let late = self.settings.interval * 3 + self.settings.timeout;
        match self.state.age() {
            Some(age) if age > late && self.state.failures() == 0 => Health::Stale,
            _ => Health::Ok,
        }
    }

    async fn ask(&self, block: &Block) -> Result<Vec<u8>, Fault> {
        let range = Range { address: block.address, quantity: block.count };
        let request = match block.area {
            Area::Coils => Request::ReadCoils(range),
            Area::DiscreteInputs => Request::ReadDiscreteInputs(range),
            Area::HoldingRegisters => Request::ReadHoldingRegisters(range),
            Area::InputRegisters => Request::ReadInputRegisters(range),
        };
        let mut buffer = [0; pdu::MAX_LEN];
        let len = request.encode(&mut buffer).ok_or(Fault::Invalid)?;
        let counters = &self.state.counters;
        counters.requests.add();
        let began = Instant::now();
        let answer =
            self.link.read(self.settings.unit_id, &buffer[..len], self.settings.timeout).await;
        match &answer {
            Ok(_) => {
                counters.valid.add();
                let micros = began.elapsed().as_micros() as u64;
                self.state.round_trip.store(micros, Ordering::Relaxed);
            }
            Err(Fault::Exception(_)) => counters.exceptions.add(),
            Err(Fault::Timeout) => counters.timeouts.add(),
            Err(_) => counters.transport_errors.add(),
        }
        answer
    }

    /// A device that can't bear so many items in one request gets fewer in all its requests, as far as
    /// its fields allow.
    fn lower_limit(&self, refused: &Block) {
        let longest = self.fields.iter().filter(|field| field.area == refused.area);
        let longest = longest.map(|field| field.count).max().unwrap_or(1);
        let limit = (refused.count / 2).max(longest);
        let mut limits = self.limits.borrow_mut();
        let now =
            if refused.area.is_bits() { &mut limits.max_bits } else { &mut limits.max_registers };
        *now = limit.min(*now);
        drop(limits);
        self.draw_plan();
        self.remember();
    }

    /// Sets the time when the first plan is tried again.
    fn remember(&self) {
        if self.revise.get().is_none() {
            self.revise.set(Some(Instant::now() + REMEMBERED));
        }
    }

    /// Puts smaller blocks in the place of one that was refused.
    fn replace(&self, refused: &Block, smaller: &[Block]) {
        let mut plan = self.plan.borrow_mut();
        if let Some(at) = plan.iter().position(|block| block == refused) {
            Rc::make_mut(&mut plan).splice(at..=at, smaller.iter().cloned());
        }
        drop(plan);
        self.note_plan();
        self.remember();
    }

    /// Takes the fields of a block out of its bytes; reads that are whole then are handed on.
    fn spread(&self, block: &Block, bytes: &[u8], gathered: &mut Gathered) {
        for index in &block.fields {
            let field = self.fields[*index];
            let (read, at) = self.parts[*index];
            let offset = usize::from(field.address - block.address);
            let settings = &self.settings.reads[read];
            let whole = settings.count == u32::from(field.count);
            if whole && !field.area.is_bits() {
                let end = offset + usize::from(field.count);
                self.hand_on(read, &bytes[offset * 2..end * 2]);
            } else if whole && offset == 0 && block.count == field.count {
                self.hand_on(read, bytes);
            } else if let Some(bytes) = gathered.put(settings, read, at, field, bytes, offset) {
                self.hand_on(read, &bytes);
            }
        }
    }

    fn hand_on(&self, index: usize, bytes: &[u8]) {
        let read = &self.settings.reads[index];
        self.state.counters.reads.add();
        self.state.counters.values.add_many(u64::from(read.count));
        let (mut area, mut address) = (read.area, read.address);
        if let Some(into) = &read.into {
            (area, address) = (into.area, into.address);
            // That it fits was checked when the poller was made.
            let _ = into.write(read.count, bytes);
        }
        if let Ok(count) = u16::try_from(read.count) {
            let code = Area::ALL.iter().position(|each| *each == area).unwrap_or_default() + 1;
            for forward in &self.forwards {
                forward.offer(index, code as u8, address, count, bytes);
            }
        }
    }

    fn tell(&self) {
        if let Some(to) = &self.settings.status {
            self.state.status().write(&self.settings.name, to);
        }
    }
}

/// What one poll brings together: reads that come in parts, and how many items are missing; and
/// all blocks, where somebody wants them.
#[derive(Default)]
struct Gathered {
    parts: HashMap<usize, (Vec<u8>, u32)>,
    blocks: Vec<BlockResult>,
    report: bool,
}

impl Gathered {
    fn note(&mut self, block: &Block, outcome: Result<Vec<u8>, Fault>) {
        if self.report {
            let Block { area, address, count, .. } = *block;
            self.blocks.push(BlockResult { area, address, count, outcome });
        }
    }

    /// Puts a field into its read; all of the read when nothing is missing any more.
    fn put(
        &mut self,
        settings: &ReadSettings,
        read: usize,
        at: u32,
        field: Field,
        block: &[u8],
        offset: usize,
    ) -> Option<Vec<u8>> {
        let len = settings.area.byte_len(settings.count as usize);
        let (whole, missing) =
            self.parts.entry(read).or_insert_with(|| (vec![0; len], settings.count));
        let (count, at) = (usize::from(field.count), at as usize);
        if field.area.is_bits() {
            for index in 0..count {
                let bit = block[(offset + index) / 8] >> ((offset + index) % 8) & 1;
                whole[(at + index) / 8] |= bit << ((at + index) % 8);
            }
        } else {
            whole[at * 2..(at + count) * 2]
                .copy_from_slice(&block[offset * 2..(offset + count) * 2]);
        }
        *missing -= u32::from(field.count);
        if *missing > 0 {
            return None;
        }
        self.parts.remove(&read).map(|(whole, _)| whole)
    }
}
