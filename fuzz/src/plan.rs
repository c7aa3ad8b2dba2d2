//! The plan of a poll: strategy and limits, then fields, readable and forbidden ranges, and cuts.

use holdfast_engine::poller::plan::{
    self, Block, Cut, Field, PlanError, PlanLimits, Strategy, Stretch,
};
use holdfast_memory::Area;

/// The bytes of the strategy and the limits.
const HEAD_LEN: usize = 7;
/// The bytes of a field, range or cut: its kind, address and count.
const PART_LEN: usize = 5;

/// Each field is in exactly one block, within the limits; no gap is forbidden. Half a block, and two that are
/// joined, hold the same fields. No plan of gaps is cheaper than the cheapest plan.
pub fn check(data: &[u8]) {
    let Some((head, parts)) = data.split_first_chunk::<HEAD_LEN>() else { return };
    let [kind, registers, bits_high, bits_low, gap, request, item] = *head;
    let (fields, limits) = read(parts, registers, u16::from_be_bytes([bits_high, bits_low]));
    let by_gap = Strategy::Gap { max_gap: gap.into() };
    let by_cost = Strategy::Cost { request: request.into(), item: f64::from(item) / 16.0 };
    let strategy = if kind % 2 == 0 { by_gap } else { by_cost };
    let blocks = match plan::plan(&fields, &limits, strategy) {
        Ok(blocks) => blocks,
        Err(error) => return assert!(is_refused(&fields, &limits, &error), "{error:?}"),
    };
    let mut held: Vec<usize> = blocks.iter().flat_map(|block| block.fields.clone()).collect();
    held.sort_unstable();
    assert!(held.into_iter().eq(0..fields.len()), "each field once: {blocks:?}");
    for block in &blocks {
        is_allowed(&fields, &limits, block);
        if let Strategy::Gap { max_gap } = strategy {
            gaps(&fields, block).for_each(|gap| assert!(gap.end - gap.start <= max_gap.into()));
        }
        if let Some([left, right]) = plan::halves(&fields, block) {
            assert!(left.fields.len().min(right.fields.len()) > 0);
            assert_eq!(plan::joined(&fields, &left, &right), *block);
        }
    }
    let other = plan::plan(&fields, &limits, by_gap).expect("the fields are the same");
    let cheapest = plan::plan(&fields, &limits, by_cost).expect("the fields are the same");
    let costs = [&cheapest, &other].map(|blocks| cost(blocks, request.into(), item.into()));
    assert!(costs[0] <= costs[1], "{cheapest:?} costs more than {other:?}");
}

fn read(parts: &[u8], max_registers: u8, max_bits: u16) -> (Vec<Field>, PlanLimits) {
    let mut fields = Vec::new();
    let mut limits =
        PlanLimits { max_registers: max_registers.into(), max_bits, ..PlanLimits::default() };
    for part in parts.chunks_exact(PART_LEN) {
        let area = Area::ALL[usize::from(part[0] >> 3) % Area::ALL.len()];
        let [address, count] = [1, 3].map(|at| u16::from_be_bytes([part[at], part[at + 1]]));
        let start = u32::from(address);
        let stretch = Stretch { area, start, end: start + u32::from(count.max(1)) };
        match part[0] % 8 {
            0 => limits.readable.push(stretch),
            1 => limits.forbidden.push(stretch),
            2 => limits.cuts.push(Cut { area, address: start }),
            _ => fields.push(Field { area, address, count }),
        }
    }
    (fields, limits)
}

fn most(limits: &PlanLimits, area: Area) -> u16 {
    if area.is_bits() { limits.max_bits } else { limits.max_registers }
}

fn stretch(area: Area, address: u16, count: u16) -> Stretch {
    let start = u32::from(address);
    Stretch { area, start, end: start + u32::from(count) }
}

fn of(field: &Field) -> Stretch {
    stretch(field.area, field.address, field.count)
}

/// Whether a field has this error.
fn is_refused(fields: &[Field], limits: &PlanLimits, error: &PlanError) -> bool {
    match *error {
        PlanError::TooLong { index, .. } => fields[index].count > most(limits, fields[index].area),
        PlanError::Empty { index } => fields[index].count == 0,
        PlanError::Beyond { index } => of(&fields[index]).end > 65_536,
        PlanError::Forbidden { index } => is_forbidden(limits, of(&fields[index])),
    }
}

fn is_forbidden(limits: &PlanLimits, part: Stretch) -> bool {
    let touches =
        |each: &Stretch| each.area == part.area && each.start < part.end && part.start < each.end;
    limits.forbidden.iter().any(touches)
}

/// What a block reads and no field of it needs, in the order of addresses.
fn gaps(fields: &[Field], block: &Block) -> impl Iterator<Item = Stretch> {
    let mut parts: Vec<Stretch> = block.fields.iter().map(|index| of(&fields[*index])).collect();
    parts.sort_by_key(|part| part.start);
    let mut end = u32::from(block.address);
    parts.into_iter().filter_map(move |part| {
        let gap = Stretch { area: part.area, start: end, end: part.start };
        end = end.max(part.end);
        (gap.start < gap.end).then_some(gap)
    })
}

fn is_allowed(fields: &[Field], limits: &PlanLimits, block: &Block) {
    let whole = stretch(block.area, block.address, block.count);
    let parts: Vec<Stretch> = block.fields.iter().map(|index| of(&fields[*index])).collect();
    assert!(block.count <= most(limits, block.area) && whole.end <= 65_536, "{block:?}");
    assert_eq!(parts.iter().map(|part| part.start).min(), Some(whole.start));
    assert_eq!(parts.iter().map(|part| part.end).max(), Some(whole.end));
    assert!(parts.iter().all(|part| part.area == block.area));
    assert!(!is_forbidden(limits, whole), "{block:?}");
    let is_of = |each: &&Stretch| each.area == block.area;
    let readable: Vec<&Stretch> = limits.readable.iter().filter(is_of).collect();
    // Another field may need what is a gap of this block: it is readable then.
    let is_needed = |gap: &Stretch| {
        fields
            .iter()
            .map(of)
            .any(|field| field.area == gap.area && field.start <= gap.start && gap.end <= field.end)
    };
    let mut items = 0;
    for gap in gaps(fields, block) {
        items += gap.end - gap.start;
        let inside = |each: &&Stretch| each.start <= gap.start && gap.end <= each.end;
        assert!(readable.is_empty() || readable.iter().any(inside) || is_needed(&gap), "{gap:?}");
    }
    assert_eq!(items, block.gaps);
    for cut in limits.cuts.iter().filter(|cut| cut.area == block.area) {
        let is_across = parts.iter().any(|part| part.start < cut.address && cut.address < part.end);
        let is_split = parts.iter().any(|part| part.end <= cut.address)
            && parts.iter().any(|part| cut.address <= part.start);
        assert!(is_across || !is_split, "{block:?} across {cut:?}");
    }
}

/// The cost of a plan, in 256ths of a register.
fn cost(blocks: &[Block], request: u64, item: u64) -> u64 {
    let items = |block: &Block| {
        u64::from(block.count) * if block.area.is_bits() { item } else { item * 16 }
    };
    blocks.iter().map(|block| request * 256 + items(block)).sum()
}
