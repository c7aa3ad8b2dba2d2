use super::*;
use crate::error::{Refusal, Refused};
use crate::follower::Follower;
use crate::memory::several_memories::write_across;
use crate::mirrored::Freshness;
use crate::seal::GateMode;
use crate::step::{Action, Done, Step, StepWrite};

const REGISTERS: Area = Area::HoldingRegisters;

fn writing(area: Area, address: u16, bytes: &[u8]) -> Write<'_> {
    Write { area, address, count: if area.is_bits() { 1 } else { bytes.len() / 2 }, bytes }
}

fn mirroring() -> Memory {
    let span = Span::new(0, 20).unwrap();
    let layout = Layout::default().with(REGISTERS, span).with(Area::Coils, span);
    let memory = Memory::new(layout, None).unwrap();
    memory.mirror(vec![Mirrored::reserved(REGISTERS, 5, 3)]).unwrap();
    memory
}

#[test]
fn only_the_mirror_writes_mirrored_ranges() {
    let memory = mirroring();
    for access in [Access::Client, Access::Ingest] {
        for (address, len, refused) in
            [(4, 1, false), (4, 2, true), (5, 1, true), (7, 9, true), (8, 1, false)]
        {
            let bytes = [1; 20];
            let done = memory.write(access, writing(REGISTERS, address, &bytes[..2 * len]));
            assert_eq!(done == Err(Refusal::Mirrored), refused, "{address} {len}");
        }
        memory.write(access, writing(Area::Coils, 5, &[1])).unwrap();
        let masked = memory.mask_write(access, REGISTERS, 6, 0, 0);
        assert_eq!(masked, Err(Refusal::Mirrored));
        let (write, mut out) = (writing(REGISTERS, 7, &[9, 9]), [0; 2]);
        let read = Read { area: REGISTERS, address: 0, count: 1, out: &mut out };
        assert_eq!(memory.write_then_read(access, write, read), Err(Refusal::Mirrored));
        let both = [(&memory, writing(REGISTERS, 0, &[7, 7])), (&memory, write)];
        let refused = Refused { index: 1, refusal: Refusal::Mirrored };
        assert_eq!(write_across(access, &both), Err(refused));
    }
    let mut out = [0; 6];
    let read = Read { area: REGISTERS, address: 5, count: 3, out: &mut out };
    memory.read(Access::Client, read).unwrap();
    assert_eq!(out, [0; 6]);
    memory.write(Access::Mirror, writing(REGISTERS, 4, &[1; 8])).unwrap();
}

#[test]
fn ranges_outside_the_area_are_refused_and_change_nothing() {
    let memory = mirroring();
    for (address, count) in [(18, 3), (0, 0)] {
        let range = Mirrored::reserved(REGISTERS, address, count);
        assert_eq!(memory.mirror(vec![range]), Err(LayoutError::MirrorOutside { address }));
    }
    let write = writing(REGISTERS, 5, &[1, 1]);
    assert_eq!(memory.write(Access::Ingest, write), Err(Refusal::Mirrored));
    memory.mirror(Vec::new()).unwrap();
    memory.write(Access::Ingest, write).unwrap();
}

/// Is stale when a test says so, and fresh after a write.
#[derive(Debug, Default)]
struct Aged(std::sync::atomic::AtomicBool);

impl Freshness for Aged {
    fn renew(&self, age: Duration, _: Option<u64>) {
        self.0.store(age > Duration::ZERO, Ordering::Relaxed);
    }

    fn must_refuse(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// A memory whose holding registers 5 to 7 are stale.
fn aging(is_reserved: bool) -> (Memory, Arc<Aged>) {
    let memory = mirroring();
    let aged = Arc::new(Aged(true.into()));
    let freshness = Some(Arc::clone(&aged) as Arc<dyn Freshness>);
    let range = Mirrored { is_reserved, freshness, ..Mirrored::reserved(REGISTERS, 5, 3) };
    memory.mirror(vec![range]).unwrap();
    (memory, aged)
}

/// What each kind of access to registers is answered with.
fn accesses(
    memory: &Arc<Memory>,
    access: Access,
    address: u16,
    count: usize,
) -> [Result<(), Refusal>; 6] {
    let bytes = [1; 40];
    let write = writing(REGISTERS, address, &bytes[..2 * count]);
    let mut out = [[0; 40]; 3];
    let [one, many, then] = out.each_mut().map(|out| Read {
        area: REGISTERS,
        address,
        count,
        out: &mut out[..2 * count],
    });
    let beside = writing(REGISTERS, 19, &[1, 1]);
    [
        memory.read(access, one),
        memory.read_many(access, &mut [many]).map_err(Refused::alone),
        memory.write_then_read(access, beside, then),
        memory.write(access, write),
        memory.mask_write(access, REGISTERS, address, 1, 1),
        write_across(access, &[(&**memory, write)]).map(drop).map_err(Refused::alone),
    ]
}

#[test]
fn while_a_range_is_stale_only_the_mirror_uses_it() {
    for access in [Access::Client, Access::Ingest] {
        let memory = Arc::new(aging(false).0);
        for (address, count) in [(5, 1), (7, 9), (5, 3)] {
            assert_eq!(accesses(&memory, access, address, count), [Err(Refusal::Stale); 6]);
        }
        assert_eq!(accesses(&memory, access, 0, 5), [Ok(()); 6]);
        assert_eq!(accesses(&memory, access, 8, 4), [Ok(()); 6]);
        let own = Read { area: REGISTERS, address: 5, count: 3, out: &mut [0; 6] };
        assert_eq!(memory.read(Access::Mirror, own), Ok(()));
        let outside = Read { area: REGISTERS, address: 7, count: 20, out: &mut [0; 40] };
        assert_eq!(memory.read(access, outside), Err(Refusal::OutOfRange));
        memory.write(Access::Mirror, writing(REGISTERS, 6, &[1; 4])).unwrap();
        assert_eq!(accesses(&memory, access, 6, 2)[0], Err(Refusal::Stale), "a part is written");
        memory.write(Access::Mirror, writing(REGISTERS, 4, &[1; 8])).unwrap();
        assert_eq!(accesses(&memory, access, 5, 3), [Ok(()); 6]);
    }
}

#[test]
fn a_reserved_range_is_never_written_and_not_read_while_it_is_stale() {
    let (memory, aged) = aging(true);
    let memory = Arc::new(memory);
    let (stale, mirrored) = (Err(Refusal::Stale), Err(Refusal::Mirrored));
    let refused = [stale, stale, stale, mirrored, mirrored, mirrored];
    assert_eq!(accesses(&memory, Access::Client, 5, 3), refused);
    aged.renew(Duration::ZERO, None);
    let refused = [Ok(()), Ok(()), Ok(()), mirrored, mirrored, mirrored];
    assert_eq!(accesses(&memory, Access::Client, 5, 3), refused);
}

#[test]
fn a_checked_write_can_be_refused_where_values_become_stale() {
    let (memory, _) = aging(true);
    for (address, count, can_refuse) in [(0, 5, false), (5, 1, true), (2, 9, true), (8, 3, false)] {
        assert_eq!(
            memory.can_refuse_checked(REGISTERS, address, count),
            can_refuse,
            "{address} {count}"
        );
        assert!(!memory.can_refuse_checked(Area::Coils, address, count));
    }
    assert!(!mirroring().can_refuse_checked(REGISTERS, 5, 3), "it is refused at once");
}

#[test]
fn a_follower_of_a_stale_range_sees_all_of_it_when_it_is_fresh_again() {
    let (memory, aged) = aging(true);
    let memory = Arc::new(memory);
    let mut follower = Follower::new(Arc::clone(&memory), [(REGISTERS, 7, 2)]).unwrap();
    assert_eq!(follower.changes(), Err(Refusal::Stale));
    aged.renew(Duration::ZERO, None);
    let all = follower.changes().unwrap();
    assert!(follower.changes().unwrap().1.is_empty());
    aged.0.store(true, Ordering::Relaxed);
    assert_eq!(follower.changes(), Err(Refusal::Stale), "nothing was written since");
    aged.renew(Duration::ZERO, None);
    assert_eq!(follower.changes(), Ok(all));
}

#[test]
fn a_stale_range_is_refused_before_the_journal_has_a_step_and_not_when_it_is_carried_out() {
    let (memory, _) = aging(false);
    let memory = Arc::new(memory);
    let members = Arc::downgrade(&memory);
    let guard = Guard { guards: false, refusal: std::sync::Mutex::default(), members };
    memory.keep_in(Arc::new(guard) as Arc<dyn Journal>, 0);
    assert_eq!(accesses(&memory, Access::Client, 5, 3), [Err(Refusal::Stale); 6]);
    let write = StepWrite::new(0, &writing(REGISTERS, 6, &[3, 4]));
    let action = Action::WriteThenRead { write, area: REGISTERS, address: 6, count: 1 };
    let step = Step { access: Access::Client, tenure: None, action };
    // Another node may know newer values.
    assert_eq!(step.carry_out(&[Arc::clone(&memory)]).unwrap().read, [3, 4]);
    memory.write(Access::Mirror, writing(REGISTERS, 5, &[1; 6])).unwrap();
    assert_eq!(accesses(&memory, Access::Client, 5, 3), [Ok(()); 6]);
}

#[test]
fn a_step_makes_a_range_as_old_as_its_values_are() {
    let stale = || {
        let (memory, aged) = aging(false);
        (Arc::new(memory), aged)
    };
    let write = StepWrite::new(0, &writing(REGISTERS, 5, &[1; 6]));
    let then = write.clone();
    let then = Action::WriteThenRead { write: then, area: REGISTERS, address: 5, count: 1 };
    for action in [Action::Write(vec![write]), then] {
        let step = Step { access: Access::Mirror, tenure: None, action };
        let ages = [Some(Duration::ZERO), Some(Duration::from_secs(1)), None];
        let found = ages.map(|age| {
            let (memory, aged) = stale();
            step.carry_out_late(&[memory], age).unwrap();
            aged.must_refuse()
        });
        assert_eq!(found, [false, true, true]);
        let (memory, aged) = aging(false);
        aged.renew(Duration::ZERO, None);
        step.carry_out_late(&[Arc::new(memory)], None).unwrap();
        assert!(!aged.must_refuse(), "newer values are not older");
    }
}

/// Carries out each step at once, and refuses accesses while it has a refusal.
#[derive(Debug)]
struct Guard {
    guards: bool,
    refusal: std::sync::Mutex<Option<Refusal>>,
    members: std::sync::Weak<Memory>,
}

impl Journal for Guard {
    fn submit(&self, step: Step, done: Done) {
        done(step.carry_out(&[self.members.upgrade().unwrap()]));
    }

    fn guards(&self) -> bool {
        self.guards
    }

    fn admit(&self) -> Result<(), Refusal> {
        self.refusal.lock().unwrap().map_or(Ok(()), Err)
    }
}

#[test]
fn a_journal_that_guards_is_asked_before_each_access_but_not_by_its_own_steps() {
    for guards in [true, false] {
        let memory = Arc::new(mirroring());
        memory.mirror(Vec::new()).unwrap();
        let (refusal, members) = (std::sync::Mutex::default(), Arc::downgrade(&memory));
        let guard = Arc::new(Guard { guards, refusal, members });
        assert!(!memory.is_replicated());
        memory.keep_in(Arc::clone(&guard) as Arc<dyn Journal>, 0);
        assert_eq!(memory.is_replicated(), guards);
        let write = writing(REGISTERS, 0, &[1, 2]);
        memory.write(Access::Client, write).unwrap();
        let mut follower = Follower::new(Arc::clone(&memory), [(REGISTERS, 0, 2)]).unwrap();
        let all = follower.changes().unwrap();
        *guard.refusal.lock().unwrap() = Some(Refusal::Behind);
        let expected = if guards { Err(Refusal::Behind) } else { Ok(()) };
        assert_eq!(follower.changes().map(drop), expected);
        for access in [Access::Client, Access::Ingest, Access::Mirror] {
            let mut out = [[0; 2]; 3];
            let [one, many, then] =
                out.each_mut().map(|out| Read { area: REGISTERS, address: 0, count: 1, out });
            assert_eq!(memory.read(access, one), expected);
            let many = memory.read_many(access, &mut [many]).map_err(Refused::alone);
            assert_eq!(many, expected);
            assert_eq!(memory.write_then_read(access, write, then), expected);
            assert_eq!(memory.write(access, write), expected);
            assert_eq!(memory.mask_write(access, REGISTERS, 0, 1, 1), expected);
            let across = write_across(access, &[(&memory, write)]);
            let across = across.map(drop).map_err(Refused::alone);
            assert_eq!(across, expected);
        }
        let step = StepWrite::new(0, &writing(REGISTERS, 0, &[3, 4]));
        let action = Action::Write(vec![step]);
        let step = Step { access: Access::Client, tenure: None, action };
        if guards {
            *guard.refusal.lock().unwrap() = None;
            assert_eq!(follower.changes(), Ok(all), "after a refusal, all is new");
        }
        step.carry_out(&[Arc::clone(&memory)]).unwrap();
        *guard.refusal.lock().unwrap() = None;
        let mut out = [0; 2];
        let read = Read { area: REGISTERS, address: 0, count: 1, out: &mut out };
        memory.read(Access::Client, read).unwrap();
        assert_eq!(out, [3, 4]);
    }
}

#[test]
fn a_journal_that_does_not_guard_is_not_asked_for_a_sealed_memory_either() {
    let layout = Layout::default().with(Area::Coils, Span::new(0, 20).unwrap());
    let gate = Gate { area: Area::Coils, address: 3, mode: GateMode::Level };
    let memory = Arc::new(Memory::new(layout, Some(gate)).unwrap());
    let refusal = std::sync::Mutex::new(Some(Refusal::Behind));
    let guard = Guard { guards: false, refusal, members: Arc::downgrade(&memory) };
    memory.keep_in(Arc::new(guard) as Arc<dyn Journal>, 0);
    let mut out = [0];
    let read = Read { area: Area::Coils, address: 0, count: 1, out: &mut out };
    assert_eq!(memory.read(Access::Ingest, read), Ok(()));
    assert_eq!(memory.write(Access::Restore, writing(Area::Coils, 4, &[1])), Ok(()));
}

#[test]
fn the_seal_of_a_guarded_memory_still_opens_and_closes() {
    let span = Span::new(0, 20).unwrap();
    let layout = Layout::default().with(Area::Coils, span);
    let gate = Gate { area: Area::Coils, address: 3, mode: GateMode::Level };
    let memory = Arc::new(Memory::new(layout, Some(gate)).unwrap());
    let (refusal, members) = (std::sync::Mutex::default(), Arc::downgrade(&memory));
    let guard = Arc::new(Guard { guards: true, refusal, members });
    memory.keep_in(Arc::clone(&guard) as Arc<dyn Journal>, 0);
    let read = || {
        let mut out = [0];
        let read = Read { area: Area::Coils, address: 0, count: 1, out: &mut out };
        memory.read(Access::Client, read)
    };
    assert_eq!(read(), Err(Refusal::Sealed));
    memory.write(Access::Ingest, writing(Area::Coils, 3, &[1])).unwrap();
    assert_eq!((read(), memory.sealed()), (Ok(()), false));
    *guard.refusal.lock().unwrap() = Some(Refusal::Differs);
    assert_eq!(read(), Err(Refusal::Differs));
    *guard.refusal.lock().unwrap() = None;
    memory.write(Access::Ingest, writing(Area::Coils, 3, &[0])).unwrap();
    assert_eq!((read(), memory.sealed()), (Err(Refusal::Sealed), true));
}
