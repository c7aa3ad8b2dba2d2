//! Plans the requests that read a set of fields, as a pure function, and changes a plan when a
//! device refuses a block.
//!
//! The rules of this file: a field is never split; a block is within the limits of the device; a
//! gap is read only where that is allowed. [`Strategy::Gap`] reads every gap up to a size.
//! [`Strategy::Cost`] finds the cheapest plan for a given cost of a request and of a register: with
//! a high cost of a request it reads all allowed gaps, with cost 0 none. The size comes from the caller, by default
//! from `tags/read_gap.py`.

use holdfast_memory::Area;
use holdfast_protocol::pdu::limit;
use thiserror::Error;

/// Bits that count as one register.
pub(super) const BITS_PER_REGISTER: f64 = 16.0;

/// A range that is read as a whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Field {
    pub area: Area,
    pub address: u16,
    /// The number of items, at least 1.
    pub count: u16,
}

/// One request, and the fields in it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Block {
    pub area: Area,
    pub address: u16,
    pub count: u16,
    /// Indexes of the fields, sorted by address.
    pub fields: Vec<usize>,
    /// Items that belong to no field.
    pub gaps: u32,
}

/// A range of one area, from `start` to before `end`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stretch {
    pub area: Area,
    pub start: u32,
    pub end: u32,
}

/// Fields that end at or before this address are not read together with fields that begin at or
/// after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cut {
    pub area: Area,
    pub address: u32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Strategy {
    /// Reads gaps of up to `max_gap` items.
    Gap { max_gap: u16 },
    /// Reads a gap if that is cheaper, with a cost for each `request` and for each `item`: a
    /// register or 16 bits.
    Cost { request: f64, item: f64 },
}

/// What a device accepts.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanLimits {
    pub max_registers: u16,
    pub max_bits: u16,
    /// Gaps are read only inside these ranges, if there are any for the area.
    pub readable: Vec<Stretch>,
    /// Ranges that are never read, not even as a gap.
    pub forbidden: Vec<Stretch>,
    pub cuts: Vec<Cut>,
}

#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum PlanError {
    #[error("field {index}: {count} items, one request reads at most {most}")]
    TooLong { index: usize, count: u16, most: u16 },
    #[error("field {index}: no items")]
    Empty { index: usize },
    #[error("field {index}: beyond address 65535")]
    Beyond { index: usize },
    #[error("field {index}: in a forbidden range")]
    Forbidden { index: usize },
}

impl PlanError {
    /// The index of the field.
    pub(super) fn field(&self) -> usize {
        match *self {
            PlanError::TooLong { index, .. }
            | PlanError::Empty { index }
            | PlanError::Beyond { index }
            | PlanError::Forbidden { index } => index,
        }
    }
}

impl Block {
    /// The offset of a field from the start of the block, in items.
    ///
    /// # Panics
    /// If the field is not inside the block: its bytes would belong to another field.
    pub(super) fn offset(&self, field: &Field) -> usize {
        let (start, end) = (u32::from(self.address), self.end());
        let inside = field.area == self.area && start <= field.address.into() && field.end() <= end;
        assert!(inside, "{field:?} is not inside {self:?}");
        usize::from(field.address - self.address)
    }

    /// The range that it reads.
    pub(super) fn range(&self) -> Field {
        Field { area: self.area, address: self.address, count: self.count }
    }

    fn end(&self) -> u32 {
        self.range().end()
    }
}

impl Default for PlanLimits {
    fn default() -> PlanLimits {
        PlanLimits {
            max_registers: limit::READ_REGISTERS,
            max_bits: limit::READ_BITS,
            readable: Vec::new(),
            forbidden: Vec::new(),
            cuts: Vec::new(),
        }
    }
}

impl PlanLimits {
    /// The most items of one request.
    pub(super) fn most(&self, area: Area) -> u16 {
        if area.is_bits() { self.max_bits } else { self.max_registers }
    }

    /// Whether a field that ends at `end` may be read together with one that begins at `start`.
    /// Overlapping fields always may.
    fn joins(&self, area: Area, end: u32, start: u32) -> bool {
        let between = |cut: &Cut| cut.area == area && end <= cut.address && cut.address <= start;
        start < end
            || (!self.cuts.iter().any(between)
                && (start == end || self.may_read_gap(area, end, start)))
    }

    /// Whether a gap may be read.
    fn may_read_gap(&self, area: Area, start: u32, end: u32) -> bool {
        let mut readable = self.readable.iter().filter(|each| each.area == area).peekable();
        let is_inside = |each: &Stretch| each.start <= start && end <= each.end;
        (readable.peek().is_none() || readable.any(is_inside))
            && !self.is_forbidden(area, start, end)
    }

    /// Whether a part of a range is never read.
    fn is_forbidden(&self, area: Area, start: u32, end: u32) -> bool {
        self.forbidden.iter().any(|each| each.area == area && start < each.end && each.start < end)
    }
}

impl Field {
    pub(super) fn end(&self) -> u32 {
        u32::from(self.address) + u32::from(self.count)
    }
}

/// Plans the blocks that read all fields, in the order of areas and addresses.
///
/// # Errors
/// [`PlanError`] for a field that cannot be read by one request.
pub fn plan(
    fields: &[Field],
    limits: &PlanLimits,
    strategy: Strategy,
) -> Result<Vec<Block>, PlanError> {
    for (index, field) in fields.iter().enumerate() {
        let most = limits.most(field.area);
        if field.count == 0 {
            return Err(PlanError::Empty { index });
        } else if field.count > most {
            return Err(PlanError::TooLong { index, count: field.count, most });
        } else if field.end() > 65_536 {
            return Err(PlanError::Beyond { index });
        }
        if limits.is_forbidden(field.area, field.address.into(), field.end()) {
            return Err(PlanError::Forbidden { index });
        }
    }
    let mut order: Vec<usize> = (0..fields.len()).collect();
    order.sort_by_key(|index| (fields[*index], *index));
    let mut blocks = Vec::new();
    for of_area in order.chunk_by(|a, b| fields[*a].area == fields[*b].area) {
        match strategy {
            Strategy::Gap { max_gap } => by_gap(fields, of_area, limits, max_gap, &mut blocks),
            Strategy::Cost { request, item } => {
                let bits = fields[of_area[0]].area.is_bits();
                let item = if bits { item / BITS_PER_REGISTER } else { item };
                by_cost(fields, of_area, limits, (request, item), &mut blocks);
            }
        }
    }
    // A field that is missing, or in two blocks, would corrupt a read with several parts.
    assert!(holds_once(fields, &blocks), "each field is in one block: {blocks:?}");
    debug_assert!(
        blocks.iter().all(|block| block.count <= limits.most(block.area) && block.end() <= 65_536),
        "every block is within the limits: {blocks:?}"
    );
    Ok(blocks)
}

/// Whether each field is in exactly one block.
fn holds_once(fields: &[Field], blocks: &[Block]) -> bool {
    let mut held = vec![0u8; fields.len()];
    for index in blocks.iter().flat_map(|block| &block.fields) {
        held[*index] = held[*index].saturating_add(1);
    }
    held.iter().all(|times| *times == 1)
}

/// Greedy from the left: a new block starts where the gap, or the block, would become too large.
fn by_gap(
    fields: &[Field],
    order: &[usize],
    limits: &PlanLimits,
    max_gap: u16,
    blocks: &mut Vec<Block>,
) {
    let mut from = 0;
    let mut end = 0;
    for (at, index) in order.iter().enumerate() {
        let field = fields[*index];
        let first = fields[order[from]];
        let start = u32::from(field.address);
        let fits =
            field.end().max(end) - u32::from(first.address) <= u32::from(limits.most(field.area));
        let near =
            start <= end.saturating_add(max_gap.into()) && limits.joins(field.area, end, start);
        if at > from && !(fits && near) {
            blocks.push(block(fields, &order[from..at]));
            from = at;
            end = 0;
        }
        end = end.max(field.end());
    }
    if from < order.len() {
        blocks.push(block(fields, &order[from..]));
    }
}

/// Finds the cheapest blocks by dynamic programming: `best[n]` is the best plan for the first `n`
/// fields.
fn by_cost(
    fields: &[Field],
    order: &[usize],
    limits: &PlanLimits,
    (request, item): (f64, f64),
    blocks: &mut Vec<Block>,
) {
    // The end of all fields up to each one: the space between it and the next field is a gap.
    let ends = order.iter().scan(0, |end, index| {
        *end = fields[*index].end().max(*end);
        Some(*end)
    });
    let ends: Vec<u32> = ends.collect();
    let mut best: Vec<(f64, usize)> = vec![(0.0, 0)];
    for upto in 1..=order.len() {
        let mut cheapest = (f64::INFINITY, upto - 1);
        let mut end = 0;
        let mut next_start = None;
        for from in (0..upto).rev() {
            let field = fields[order[from]];
            let start = u32::from(field.address);
            end = end.max(field.end());
            if end - start > u32::from(limits.most(field.area)) {
                break;
            }
            if let Some(next) = next_start
                && !limits.joins(field.area, ends[from], next)
            {
                break;
            }
            next_start = Some(start);
            // What lies inside earlier fields costs nothing beside them. In a block without them, the
            // space that they fill would be a gap.
            if from > 0 && field.end() <= ends[from - 1] {
                continue;
            }
            let cost = best[from].0 + request + item * f64::from(end - start);
            // With equal costs, the longer block wins: it saves requests.
            if cost <= cheapest.0 {
                cheapest = (cost, from);
            }
        }
        best.push(cheapest);
    }
    let mut cuts = Vec::new();
    let mut upto = order.len();
    while upto > 0 {
        let from = best[upto].1;
        cuts.push((from, upto));
        upto = from;
    }
    blocks.extend(cuts.iter().rev().map(|(from, upto)| block(fields, &order[*from..*upto])));
}

/// The end of the last of some fields.
fn reach(fields: &[Field], order: &[usize]) -> u32 {
    order.iter().map(|index| fields[*index].end()).fold(0, u32::max)
}

fn block(fields: &[Field], order: &[usize]) -> Block {
    let first = fields[order[0]];
    let start = u32::from(first.address);
    let (mut end, mut gaps) = (start, 0);
    for index in order {
        let field = fields[*index];
        gaps += u32::from(field.address).saturating_sub(end);
        end = end.max(field.end());
    }
    debug_assert!(end - start <= u32::from(u16::MAX), "a block has at most 65535 items");
    let count = (end - start) as u16;
    Block { area: first.area, address: first.address, count, fields: order.to_vec(), gaps }
}

/// Splits a refused block in two; `None` for a block of one field, or of equal ones. The halves overlap
/// if there is no cut between fields.
pub fn halves(fields: &[Field], refused: &Block) -> Option<[Block; 2]> {
    let (first, last) = (refused.fields.first()?, refused.fields.last()?);
    if fields[*first] == fields[*last] {
        return None;
    }
    let middle = refused.fields.len() / 2;
    let clean = (1..refused.fields.len())
        .filter(|cut| {
            let (left, right) = refused.fields.split_at(*cut);
            reach(fields, left) <= u32::from(fields[right[0]].address)
        })
        .min_by_key(|cut| cut.abs_diff(middle));
    let (left, right) = refused.fields.split_at(clean.unwrap_or(middle));
    Some([block(fields, left), block(fields, right)])
}

/// Merges two neighbouring blocks.
pub fn joined(fields: &[Field], left: &Block, right: &Block) -> Block {
    block(fields, &[&left.fields[..], &right.fields[..]].concat())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field(address: u16, count: u16) -> Field {
        Field { area: Area::HoldingRegisters, address, count }
    }

    fn spans(blocks: &[Block]) -> Vec<(u16, u16)> {
        blocks.iter().map(|block| (block.address, block.count)).collect()
    }

    #[test]
    fn gaps_up_to_max_gap_are_read_and_larger_ones_are_not() {
        let fields = [field(20, 2), field(0, 4), field(6, 2), field(11, 1)];
        let strategy = Strategy::Gap { max_gap: 3 };
        let blocks = plan(&fields, &PlanLimits::default(), strategy).unwrap();
        assert_eq!(spans(&blocks), [(0, 12), (20, 2)]);
        assert_eq!((blocks[0].fields.clone(), blocks[0].gaps), (vec![1, 2, 3], 5));
    }

    #[test]
    fn limits_and_forbidden_ranges_split_blocks() {
        let area = Area::HoldingRegisters;
        let limits = PlanLimits {
            max_registers: 10,
            forbidden: vec![Stretch { area, start: 13, end: 14 }],
            ..PlanLimits::default()
        };
        let fields = [field(0, 6), field(6, 5), field(12, 1), field(14, 1), field(15, 1)];
        let blocks = plan(&fields, &limits, Strategy::Gap { max_gap: 9 }).unwrap();
        assert_eq!(spans(&blocks), [(0, 6), (6, 7), (14, 2)]);
        let cost = Strategy::Cost { request: 100.0, item: 1.0 };
        assert_eq!(plan(&fields, &limits, cost).unwrap().len(), 3);
        assert_eq!(plan(&[field(13, 1)], &limits, cost), Err(PlanError::Forbidden { index: 0 }));
    }

    #[test]
    fn gaps_outside_readable_ranges_are_not_read() {
        let area = Area::HoldingRegisters;
        let readable = vec![Stretch { area, start: 0, end: 10 }];
        let limits = PlanLimits { readable, ..PlanLimits::default() };
        let fields = [field(0, 1), field(5, 1), field(9, 1), field(12, 1)];
        for strategy in [Strategy::Gap { max_gap: 50 }, Strategy::Cost { request: 1e6, item: 1.0 }]
        {
            assert_eq!(spans(&plan(&fields, &limits, strategy).unwrap()), [(0, 10), (12, 1)]);
        }
    }

    #[test]
    fn the_cost_of_a_request_decides_which_gaps_are_read() {
        let fields = [field(0, 1), field(11, 1), field(100, 1)];
        let of = |request: f64| {
            let strategy = Strategy::Cost { request, item: 1.0 };
            spans(&plan(&fields, &PlanLimits::default(), strategy).unwrap())
        };
        assert_eq!(of(0.0), [(0, 1), (11, 1), (100, 1)]);
        assert_eq!(of(11.0), [(0, 12), (100, 1)]);
        assert_eq!(of(1000.0), [(0, 101)]);
    }

    #[test]
    fn a_refused_block_is_halved_until_one_field_is_left() {
        let fields = [field(0, 1), field(1, 1), field(2, 2), field(9, 1)];
        let all = plan(&fields, &PlanLimits::default(), Strategy::Gap { max_gap: 9 }).unwrap();
        assert_eq!(spans(&all), [(0, 10)]);
        let [left, right] = halves(&fields, &all[0]).unwrap();
        assert_eq!(spans(&[left.clone(), right.clone()]), [(0, 2), (2, 8)]);
        assert_eq!(joined(&fields, &left, &right), all[0]);
        let [left, right] = halves(&fields, &right).unwrap();
        assert_eq!(spans(&[left.clone(), right]), [(2, 2), (9, 1)]);
        assert_eq!(halves(&fields, &left), None);
    }

    #[test]
    fn overlapping_fields_of_a_refused_block_are_read_apart() {
        let fields = [field(8, 1), field(8, 4), field(10, 4), field(10, 4)];
        let [left, right] = halves(&fields, &block(&fields, &[0, 1, 2, 3])).unwrap();
        assert_eq!(spans(&[left.clone(), right.clone()]), [(8, 4), (10, 4)]);
        let [inner, outer] = halves(&fields, &left).unwrap();
        assert_eq!(spans(&[inner, outer]), [(8, 1), (8, 4)]);
        assert_eq!(halves(&fields, &right), None, "equal fields are one");
    }

    #[test]
    fn a_field_inside_another_is_read_with_it() {
        let area = Area::HoldingRegisters;
        let cuts = vec![Cut { area, address: 5 }];
        let limits = PlanLimits { max_registers: 10, cuts, ..PlanLimits::default() };
        let fields = [field(0, 10), field(2, 1), field(8, 4)];
        let strategy = Strategy::Cost { request: 1.0, item: 0.0 };
        assert_eq!(spans(&plan(&fields, &limits, strategy).unwrap()), [(0, 10), (8, 4)]);
    }

    #[test]
    fn nothing_is_read_across_a_cut() {
        let area = Area::HoldingRegisters;
        let cuts = [4, 10, 30].map(|address| Cut { area, address }).to_vec();
        let limits = PlanLimits { cuts, ..PlanLimits::default() };
        let fields = [field(0, 4), field(4, 2), field(8, 4), field(11, 5), field(20, 1)];
        for strategy in [Strategy::Gap { max_gap: 50 }, Strategy::Cost { request: 1e6, item: 1.0 }]
        {
            let blocks = plan(&fields, &limits, strategy).unwrap();
            assert_eq!(spans(&blocks), [(0, 4), (4, 17)]);
        }
    }

    #[test]
    fn a_field_that_no_request_can_read_is_an_error() {
        let strategy = Strategy::Gap { max_gap: 0 };
        for (bad, error) in [
            (field(0, 126), PlanError::TooLong { index: 0, count: 126, most: 125 }),
            (field(0, 0), PlanError::Empty { index: 0 }),
            (field(65_535, 2), PlanError::Beyond { index: 0 }),
        ] {
            assert_eq!(plan(&[bad], &PlanLimits::default(), strategy), Err(error));
        }
    }
}
