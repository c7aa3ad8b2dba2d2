//! Compares the memory with a model that keeps one value per address: every operation has the same
//! result on both, refusals included.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use holdfast_memory::{
    Access, Area, CarriedOut, Done, Gate, GateMode, Journal, Layout, Memory, Mirrored, Operation,
    Read, Refusal, Refused, Span, Step as Kept, Write, write_across,
};
use proptest::prelude::*;

/// One value per address. A missing address is outside the area.
#[derive(Debug, Clone, PartialEq, Default)]
struct Model {
    areas: BTreeMap<Area, BTreeMap<u16, u16>>,
    gate: Option<Gate>,
    sealed: bool,
}

#[derive(Debug, Clone)]
enum Step {
    Read(Access, Area, u16, usize),
    Write(Access, Vec<Values>),
    Mask(Access, Area, u16, u16, u16),
    WriteThenRead(Access, Values, (Area, u16, usize)),
}

#[derive(Debug, Clone)]
struct Values {
    area: Area,
    address: u16,
    values: Vec<u16>,
}

impl Values {
    fn pack(&self) -> Vec<u8> {
        if !self.area.is_bits() {
            return self.values.iter().flat_map(|value| value.to_be_bytes()).collect();
        }
        let mut bytes = vec![0; self.values.len().div_ceil(8)];
        for (index, value) in self.values.iter().enumerate() {
            bytes[index / 8] |= ((value & 1) as u8) << (index % 8);
        }
        // Stray bits beyond the last one must not reach memory.
        if let (Some(last), used @ 1..) = (bytes.last_mut(), self.values.len() % 8) {
            *last |= 0xFF << used;
        }
        bytes
    }

    fn packed<'a>(&self, bytes: &'a [u8]) -> Write<'a> {
        Write { area: self.area, address: self.address, count: self.values.len(), bytes }
    }
}

fn unpack(area: Area, count: usize, bytes: &[u8]) -> Vec<u16> {
    if area.is_bits() {
        assert!((count..bytes.len() * 8).all(|bit| bytes[bit / 8] >> (bit % 8) & 1 == 0));
        (0..count).map(|bit| u16::from(bytes[bit / 8] >> (bit % 8) & 1)).collect()
    } else {
        bytes.chunks(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
    }
}

impl Model {
    fn new(layout: &Layout, gate: Option<Gate>) -> Model {
        let areas = layout.areas().map(|area| {
            let span = layout.span(area);
            let addresses = u32::from(span.start())..span.end();
            (area, addresses.map(|address| (address as u16, 0)).collect())
        });
        Model { areas: areas.collect(), gate, sealed: gate.is_some() }
    }

    fn addresses(&self, area: Area, address: u16, count: usize) -> Result<Vec<u16>, Refusal> {
        let addresses = (0..count).map(|index| u16::try_from(usize::from(address) + index));
        let addresses: Result<Vec<u16>, _> = addresses.collect();
        let addresses = addresses.map_err(|_| Refusal::OutOfRange)?;
        let known = self.areas.get(&area).ok_or(Refusal::OutOfRange)?;
        let inside = addresses.iter().all(|address| known.contains_key(address));
        if inside { Ok(addresses) } else { Err(Refusal::OutOfRange) }
    }

    fn admit(&self, access: Access) -> Result<(), Refusal> {
        match access {
            Access::Client if self.sealed => Err(Refusal::Sealed),
            Access::Restore if !self.sealed => Err(Refusal::Unsealed),
            _ => Ok(()),
        }
    }

    fn read(
        &self,
        access: Access,
        area: Area,
        address: u16,
        count: usize,
    ) -> Result<Vec<u16>, Refusal> {
        self.admit(access)?;
        let addresses = self.addresses(area, address, count)?;
        Ok(addresses.iter().map(|address| self.areas[&area][address]).collect())
    }

    fn write(&mut self, access: Access, writes: &[Values]) -> Result<(), Refusal> {
        self.admit(access)?;
        for write in writes {
            self.checked(access, write)?;
        }
        self.apply(access, writes);
        Ok(())
    }

    fn checked(&self, access: Access, write: &Values) -> Result<(), Refusal> {
        if write.values.is_empty() {
            return Err(Refusal::WrongLength);
        }
        let addresses = self.addresses(write.area, write.address, write.values.len())?;
        let hits_gate = self
            .gate
            .is_some_and(|gate| gate.area == write.area && addresses.contains(&gate.address));
        if hits_gate && access == Access::Client { Err(Refusal::GateBit) } else { Ok(()) }
    }

    /// Carries out writes that have been checked, then updates the seal.
    fn apply<'w>(&mut self, access: Access, writes: impl IntoIterator<Item = &'w Values>) {
        for Values { area, address, values } in writes {
            for (index, value) in values.iter().enumerate() {
                let value = if area.is_bits() { value & 1 } else { *value };
                self.areas.get_mut(area).unwrap().insert(address + index as u16, value);
            }
        }
        if let (Access::Ingest | Access::Restore, Some(gate)) = (access, self.gate) {
            let open = self.areas[&gate.area][&gate.address] == 1;
            self.sealed = !open && (gate.mode == GateMode::Level || self.sealed);
        }
    }

    fn contents(&self) -> Vec<Vec<u16>> {
        LAYOUT.iter().map(|&(area, ..)| self.areas[&area].values().copied().collect()).collect()
    }
}

/// A journal that carries out each step at once.
#[derive(Debug)]
struct AtOnce(Vec<Weak<Memory>>);

impl Journal for AtOnce {
    fn submit(&self, step: Kept, done: Done) {
        let members: Vec<_> = self.0.iter().map(|memory| memory.upgrade().unwrap()).collect();
        done(step.carry_out(&members));
    }
}

/// Lets one journal carry out the writes to all of these memories.
fn keep(memories: &[Arc<Memory>]) {
    let journal: Arc<dyn Journal> = Arc::new(AtOnce(memories.iter().map(Arc::downgrade).collect()));
    for (member, memory) in (0..).zip(memories) {
        memory.keep_in(Arc::clone(&journal), member);
    }
}

/// The model of `write_across`: refuses the first invalid write, then the first write to a sealed
/// memory.
fn model_write_across(
    models: &mut [Model; 3],
    access: Access,
    batch: &[(usize, Values)],
) -> Result<(), Refused> {
    for (index, (which, write)) in batch.iter().enumerate() {
        models[*which].checked(access, write).map_err(|refusal| Refused { index, refusal })?;
    }
    for (index, (which, _)) in batch.iter().enumerate() {
        models[*which].admit(access).map_err(|refusal| Refused { index, refusal })?;
    }
    for (which, model) in models.iter_mut().enumerate() {
        let mut writes = batch.iter().filter(|(to, _)| *to == which).map(|(_, w)| w).peekable();
        if writes.peek().is_some() {
            model.apply(access, writes);
        }
    }
    Ok(())
}

const LAYOUT: [(Area, u16, u32); 6] = [
    (Area::Coils, 3, 40),
    (Area::DiscreteInputs, 0, 21),
    (Area::HoldingRegisters, 65_500, 36),
    // Not in the order of their numbers.
    (Area::File(4), 0, 33),
    (Area::File(1), 0, 1),
    (Area::File(u16::MAX), 5, 20),
];

fn layout() -> Layout {
    LAYOUT.iter().fold(Layout::default(), |layout, &(area, start, size)| {
        layout.with(area, Span::new(start, size).unwrap())
    })
}

fn read(
    memory: &Memory,
    access: Access,
    area: Area,
    address: u16,
    count: usize,
) -> Result<Vec<u16>, Refusal> {
    let mut out = vec![0xAA; area.byte_len(count)];
    memory.read(access, Read { area, address, count, out: &mut out })?;
    Ok(unpack(area, count, &out))
}

fn contents(memory: &Memory) -> Vec<Vec<u16>> {
    LAYOUT
        .iter()
        .map(|&(area, start, size)| {
            read(memory, Access::Ingest, area, start, size as usize).unwrap()
        })
        .collect()
}

fn a_range() -> impl Strategy<Value = (Area, u16, usize)> {
    let files = [1, 2, 4, u16::MAX].map(Area::File);
    let area = prop::sample::select([&Area::ALL[..], &files].concat());
    let address = prop_oneof![4 => 0..45u16, 4 => 65_495..=65_535u16, 1 => any::<u16>()];
    (area, address, 1..42usize)
}

fn an_access() -> impl Strategy<Value = Access> {
    prop_oneof![Just(Access::Client), Just(Access::Ingest), Just(Access::Restore)]
}

fn some_values() -> impl Strategy<Value = Values> {
    a_range().prop_flat_map(|(area, address, count)| {
        prop::collection::vec(any::<u16>(), count).prop_map(move |values| Values {
            area,
            address,
            values,
        })
    })
}

/// A write that every memory refuses: no such area, out of range, or no values.
fn a_bad_write() -> impl Strategy<Value = (usize, Values)> {
    let place = prop_oneof![
        Just((Area::InputRegisters, 0, 1)),
        Just((Area::Coils, 2, 2)),
        Just((Area::Coils, 42, 2)),
        Just((Area::DiscreteInputs, 21, 1)),
        Just((Area::HoldingRegisters, 65_535, 2)),
        Just((Area::HoldingRegisters, 65_500, 0)),
        Just((Area::File(2), 0, 1)),
        Just((Area::File(1), 0, 2)),
        Just((Area::File(u16::MAX), 4, 2)),
        Just((Area::File(u16::MAX), 24, 2)),
    ];
    (0..3usize, place).prop_map(|(which, (area, address, count))| {
        (which, Values { area, address, values: vec![1; count] })
    })
}

fn a_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        (an_access(), a_range())
            .prop_map(|(access, (area, address, count))| Step::Read(access, area, address, count)),
        (an_access(), prop::collection::vec(some_values(), 1..4))
            .prop_map(|(access, writes)| Step::Write(access, writes)),
        (an_access(), a_range(), any::<u16>(), any::<u16>()).prop_map(
            |(access, (area, address, _), and, or)| Step::Mask(access, area, address, and, or)
        ),
        (an_access(), some_values(), a_range())
            .prop_map(|(access, write, read)| Step::WriteThenRead(access, write, read)),
    ]
}

fn a_gate() -> impl Strategy<Value = Option<Gate>> {
    let mode = prop_oneof![Just(GateMode::Once), Just(GateMode::Level)];
    prop::option::of((0..21u16, mode).prop_map(|(address, mode)| Gate {
        area: Area::DiscreteInputs,
        address,
        mode,
    }))
}

fn take(memory: &Memory, model: &mut Model, step: Step) {
    match step {
        Step::Read(access, area, address, count) => {
            assert_eq!(
                read(memory, access, area, address, count),
                model.read(access, area, address, count)
            );
        }
        Step::Write(access, writes) => {
            let packed: Vec<Vec<u8>> = writes.iter().map(Values::pack).collect();
            let borrowed: Vec<Write> =
                writes.iter().zip(&packed).map(|(write, bytes)| write.packed(bytes)).collect();
            let done = memory.write_many(access, &borrowed).map_err(|refused| refused.refusal);
            assert_eq!(done, model.write(access, &writes));
        }
        Step::Mask(access, area, address, and, or) => {
            let done = memory.mask_write(access, area, address, and, or);
            let expected = model.admit(access).and_then(|()| {
                if area.is_bits() {
                    return Err(Refusal::NotRegisters);
                }
                let now = model.read(access, area, address, 1)?[0];
                let values = vec![(now & and) | (or & !and)];
                model.write(access, &[Values { area, address, values }])
            });
            assert_eq!(done, expected);
        }
        Step::WriteThenRead(access, write, (area, address, count)) => {
            let mut out = vec![0; area.byte_len(count)];
            let bytes = write.pack();
            let done = memory
                .write_then_read(
                    access,
                    write.packed(&bytes),
                    Read { area, address, count, out: &mut out },
                )
                .map(|()| unpack(area, count, &out));
            let mut after = model.clone();
            let expected = after.write(access, std::slice::from_ref(&write)).and_then(|()| {
                // The write of this step may close the seal. Its own read still succeeds.
                after.read(Access::Ingest, area, address, count)
            });
            if expected.is_ok() {
                *model = after;
            }
            assert_eq!(done, expected);
        }
    }
}

proptest! {
    #[test]
    fn memory_and_model_agree(
        gate in a_gate(),
        steps in prop::collection::vec(a_step(), 1..60),
        is_kept in any::<bool>(),
    ) {
        let memory = Arc::new(Memory::new(layout(), gate).unwrap());
        if is_kept {
            keep(std::slice::from_ref(&memory));
        }
        let mut model = Model::new(&layout(), gate);
        for step in steps {
            take(&memory, &mut model, step);
            prop_assert_eq!(memory.sealed(), model.sealed);
        }
        prop_assert_eq!(contents(&memory), model.contents());
    }

    #[test]
    fn a_batch_over_several_memories_is_written_completely_or_not_at_all(
        gates in prop::array::uniform3(a_gate()),
        earlier in prop::collection::vec((0..3usize, some_values()), 0..20),
        access in an_access(),
        // Covers short batches, which are written directly, and long ones, which are flattened.
        batch in prop_oneof![
            prop::collection::vec((0..3usize, some_values()), 0..8),
            prop::collection::vec((0..3usize, some_values()), 8..120),
        ],
        bad in prop::collection::vec((any::<prop::sample::Index>(), a_bad_write()), 0..3),
        are_kept in any::<bool>(),
    ) {
        let memories = gates.map(|gate| Arc::new(Memory::new(layout(), gate).unwrap()));
        if are_kept {
            keep(&memories);
        }
        let mut models = gates.map(|gate| Model::new(&layout(), gate));
        for (which, write) in &earlier {
            let _ = models[*which].write(Access::Ingest, std::slice::from_ref(write));
            let _ = memories[*which].write(Access::Ingest, write.packed(&write.pack()));
        }
        let mut batch = batch;
        batch.retain(|(which, write)| models[*which].checked(access, write).is_ok());
        for (place, write) in bad {
            batch.insert(place.index(batch.len() + 1), write);
        }
        let packed: Vec<Vec<u8>> = batch.iter().map(|(_, write)| write.pack()).collect();
        let writes: Vec<(&Memory, Write)> = batch
            .iter()
            .zip(&packed)
            .map(|((which, write), bytes)| (&*memories[*which], write.packed(bytes)))
            .collect();
        let changes = memories.each_ref().map(|memory| memory.seal_changes());

        let done = write_across(access, &writes).map(drop);

        let expected = model_write_across(&mut models, access, &batch);
        prop_assert_eq!(done, expected);
        for (memory, model) in memories.iter().zip(&models) {
            prop_assert_eq!(memory.sealed(), model.sealed);
            prop_assert_eq!(contents(memory), model.contents());
        }
        if done.is_err() {
            prop_assert_eq!(memories.each_ref().map(|memory| memory.seal_changes()), changes);
        }
    }
}

#[test]
fn a_range_without_items_is_refused() {
    let memory = Memory::new(layout(), None).unwrap();
    let area = Area::Coils;
    let read = Read { area, address: 3, count: 0, out: &mut [] };
    assert_eq!(memory.read(Access::Client, read), Err(Refusal::WrongLength));
    let write = Write { area, address: 3, count: 0, bytes: &[] };
    assert_eq!(memory.write(Access::Client, write), Err(Refusal::WrongLength));
}

#[test]
fn a_span_beyond_the_last_address_is_refused() {
    assert!(Span::new(65_535, 1).is_ok());
    assert!(Span::new(0, 65_536).is_ok());
    assert!(Span::new(1, 65_536).is_err());
    assert!(Span::new(0, u32::MAX).is_err());
}

#[test]
fn an_area_has_its_name_back() {
    for area in Area::ALL {
        assert_eq!(Area::from_name(&area.name()), Some(area));
    }
    for file in [1, 10, u16::MAX].map(Area::File) {
        assert_eq!(Area::file_from_name(&file.name()), Some(file));
        assert_eq!(Area::from_name(&file.name()), None);
    }
    for name in ["file", "file:", "file:01", "file:+1", "file:65536", "file:0", "File:1", ""] {
        assert_eq!(Area::file_from_name(name), None, "{name}");
    }
}

#[test]
fn a_gate_outside_its_area_is_refused() {
    let gate = |area, address| Some(Gate { area, address, mode: GateMode::Once });
    assert!(Memory::new(layout(), gate(Area::Coils, 2)).is_err());
    assert!(Memory::new(layout(), gate(Area::HoldingRegisters, 65_500)).is_err());
    assert!(Memory::new(layout(), gate(Area::Coils, 42)).is_ok());
}

#[test]
fn memories_of_different_journals_are_not_written_in_one_step() {
    let [one, other, alone] = [(); 3].map(|()| Arc::new(Memory::new(layout(), None).unwrap()));
    keep(std::slice::from_ref(&one));
    keep(std::slice::from_ref(&other));
    let write = Write { area: Area::Coils, address: 3, count: 1, bytes: &[1] };
    for (batch, index) in
        [([&one, &other], 1), ([&one, &alone], 1), ([&alone, &one], 0), ([&other, &one], 1)]
    {
        let writes = batch.map(|memory| (&**memory, write));
        let refused = Refused { index, refusal: Refusal::NotOneStep };
        assert_eq!(write_across(Access::Ingest, &writes), Err(refused));
    }
    for memory in [one, other, alone] {
        assert_eq!(contents(&memory)[0], vec![0; 40]);
    }
}

#[test]
fn reserved_ranges_are_settled_when_a_step_is_given_to_the_journal() {
    let memory = Arc::new(Memory::new(layout(), None).unwrap());
    keep(std::slice::from_ref(&memory));
    memory.mirror(vec![Mirrored::reserved(Area::Coils, 10, 5)]).unwrap();
    let write = Write { area: Area::Coils, address: 12, count: 1, bytes: &[1] };
    let never = || -> Done { Box::new(|_| panic!("nothing is submitted")) };
    for access in [Access::Client, Access::Ingest] {
        let refused = memory.submit(access, Operation::Write(&[write]), never());
        assert_eq!(refused, Err(Refusal::Mirrored));
        assert_eq!(memory.write(access, write), Err(Refusal::Mirrored));
    }
    memory.write(Access::Mirror, write).unwrap();
    assert_eq!(read(&memory, Access::Client, Area::Coils, 12, 1), Ok(vec![1]));
    // On another node, the range may be reserved.
    memory.mirror(vec![Mirrored::reserved(Area::Coils, 3, 40)]).unwrap();
    let step = Kept {
        access: Access::Client,
        tenure: None,
        action: holdfast_memory::Action::Write(vec![holdfast_memory::StepWrite {
            member: 0,
            area: Area::Coils,
            address: 3,
            count: 1,
            bytes: vec![1],
        }]),
    };
    assert_eq!(step.carry_out(std::slice::from_ref(&memory)), Ok(CarriedOut::default()));
}

#[test]
fn a_step_without_an_outcome_is_not_confirmed() {
    #[derive(Debug)]
    struct Forgetful;
    impl Journal for Forgetful {
        fn submit(&self, _: Kept, done: Done) {
            drop(done);
        }
    }
    assert!(!Forgetful.guards(), "it has no contents of its own");
    let memory = Memory::new(layout(), None).unwrap();
    memory.keep_in(Arc::new(Forgetful), 0);
    let write = Write { area: Area::Coils, address: 3, count: 1, bytes: &[1] };
    assert_eq!(memory.write(Access::Client, write), Err(Refusal::NotConfirmed));
}

#[test]
fn contents_can_be_copied_and_restored() {
    let gate = Gate { area: Area::Coils, address: 3, mode: GateMode::Level };
    let [before, after] = [(); 2].map(|()| Arc::new(Memory::new(layout(), Some(gate)).unwrap()));
    let write = Write { area: Area::Coils, address: 3, count: 9, bytes: &[0xFF, 1] };
    before.write(Access::Ingest, write).unwrap();
    let copied = Memory::contents(&[Arc::clone(&before), Arc::clone(&after)]);
    assert_ne!(copied[0], copied[1]);
    after.restore(&copied[0]);
    assert_eq!((contents(&after), after.sealed()), (contents(&before), false));
}
