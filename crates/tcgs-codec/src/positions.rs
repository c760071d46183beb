//! Anchor cells as an occupancy octree, level by level from the root, with adaptive binary contexts.
//!
//! A level is known in full before its children are coded, so a child's context can include the nodes at the outer sides of its parent.
//! The last level is the cells in Morton order. Trained anchors are sparse and most nodes have one child, so that is coded first, which
//! halves the number of decisions.

use super::{
    adaptive::AdaptiveBit,
    bytes::{Reader, Writer},
    error::{EncodeError, Result},
    morton::{self, AXIS_BITS},
    range::{BitCoder, StreamDecoder, StreamEncoder},
};

const PART: &str = "positions";

/// Cells of a scene in the order of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Ordered {
    /// Least coordinate on each axis.
    pub(super) min: [i32; 3],
    /// Octree levels: coordinates relative to `least` are below 2^depth.
    pub(super) depth: u32,
    /// Morton codes of the relative coordinates, ascending.
    pub(super) codes: Vec<u64>,
    /// `order[i]` is the index in the input of the cell that comes `i`-th.
    pub(super) order: Vec<usize>,
}

/// Sorts cells into the order of a file.
pub(super) fn order(cells: &[[i32; 3]]) -> Result<Ordered, EncodeError> {
    let _stage = tracing::debug_span!("order").entered();
    let bound = |axis: usize, pick: fn(i32, i32) -> i32| cells.iter().map(|cell| cell[axis]).reduce(pick);
    let mut min = [0; 3];
    let mut widest = 0;
    for (axis, min) in min.iter_mut().enumerate() {
        let (Some(low), Some(high)) = (bound(axis, i32::min), bound(axis, i32::max)) else {
            return Err(EncodeError::Empty);
        };
        *min = low;
        widest = widest.max(high.abs_diff(low));
    }
    if widest >> AXIS_BITS != 0 {
        return Err(EncodeError::TooLarge {
            what: "cells along one axis",
            value: u64::from(widest) + 1,
            limit: 1 << AXIS_BITS,
        });
    }
    let code = |cell: &[i32; 3]| morton::interleave([0, 1, 2].map(|axis| cell[axis].abs_diff(min[axis])));
    let mut sorted: Vec<(u64, usize)> = cells.iter().map(code).zip(0..).collect();
    sorted.sort_unstable();
    if let Some(pair) = sorted.windows(2).find(|pair| pair[0].0 == pair[1].0) {
        return Err(EncodeError::DuplicateCell { cell: cells[pair[0].1] });
    }
    let (codes, order) = sorted.into_iter().unzip();
    Ok(Ordered { min, depth: u32::BITS - widest.leading_zeros(), codes, order })
}

/// The positions section.
pub(super) fn encode(cells: &Ordered) -> Vec<u8> {
    let _stage = tracing::debug_span!("positions").entered();
    let mut writer = Writer::new();
    cells.min.iter().for_each(|low| writer.signed(i64::from(*low)));
    writer.u8(cells.depth as u8);
    let mut stream = StreamEncoder::new();
    let mut contexts = PositionContexts::new();
    let mut level = Level::root();
    for (depth, families) in families(cells).into_iter().enumerate() {
        let below = cells.depth - 1 - depth as u32;
        for (sides, family) in level.sides.iter().zip(&families) {
            // The encoder returns its input.
            let _ = code_family(&mut stream, &mut contexts, Sides::of(sides), below, *family);
        }
        level = level.children(&families);
    }
    writer.raw(&stream.finish());
    writer.into_bytes()
}

/// Bytes of the positions section for `cells`, without what counts and checks it.
///
/// # Errors
/// As of [`encode`](super::encode()): no cells, two equal ones, or some too far from each other.
pub fn position_bytes(cells: &[[i32; 3]]) -> Result<usize, EncodeError> {
    Ok(encode(&order(cells)?).len())
}

/// For each level from the root, for each of its nodes, which children exist.
fn families(cells: &Ordered) -> Vec<Vec<u8>> {
    let mut levels = Vec::new();
    let mut nodes = cells.codes.clone();
    for _ in 0..cells.depth {
        let siblings = |a: &u64, b: &u64| a >> 3 == b >> 3;
        let family = |children: &[u64]| children.iter().fold(0, |bits, child| bits | 1_u8 << (child & 7));
        levels.push(nodes.chunk_by(siblings).map(family).collect());
        nodes = nodes.chunk_by(siblings).map(|children| children[0] >> 3).collect();
    }
    levels.reverse();
    levels
}

/// More anchors than a section of `length` bytes can hold: an anchor takes at least one decision, and none is likelier
/// than 65504 in 65536, which is 0.0007 bits.
pub(super) fn max_anchors_exclusive(length: usize) -> u64 {
    11_400 * (length as u64 + 4)
}

/// Reads the positions section of a file with `count` anchors, in file order.
pub(super) fn decode(section: &[u8], count: usize) -> Result<Vec<[i32; 3]>> {
    let _stage = tracing::debug_span!("positions").entered();
    let mut reader = Reader::new(PART, section);
    let mut min = [0_i64; 3];
    for low in &mut min {
        *low = reader.signed("least cell")?;
    }
    let depth = u32::from(reader.u8("depth")?);
    if depth > AXIS_BITS {
        return Err(reader.malformed("depth", depth));
    }
    let wide = (1_i64 << depth) - 1;
    let fits = |low: &i64| i32::try_from(*low).is_ok() && i32::try_from(low.saturating_add(wide)).is_ok();
    if !min.iter().all(fits) {
        return Err(reader.malformed("least cell", format!("{min:?}")));
    }
    let mut stream = StreamDecoder::new(PART, reader.rest())?;
    let mut contexts = PositionContexts::new();
    let mut level = Level::root();
    for below in (0..depth).rev() {
        let mut families = Vec::with_capacity(level.codes.len());
        let mut children = 0;
        for sides in &level.sides {
            let family = code_family(&mut stream, &mut contexts, Sides::of(sides), below, 0)?;
            children += family.count_ones() as usize;
            if children > count {
                return Err(reader.malformed("number of cells", format!("over the stated {count}")));
            }
            families.push(family);
        }
        level = level.children(&families);
    }
    stream.finish()?;
    if level.codes.len() != count {
        let value = format!("{} where {count} are stated", level.codes.len());
        return Err(reader.malformed("number of cells", value));
    }
    let cell = |code: &u64| {
        let relative = morton::deinterleave(*code);
        [0, 1, 2].map(|axis| (min[axis] + i64::from(relative[axis])) as i32)
    };
    Ok(level.codes.iter().map(cell).collect())
}

/// Codes which children a node has, at least one; `below` is the number of levels beneath the children's.
fn code_family(
    stream: &mut impl BitCoder,
    contexts: &mut PositionContexts,
    sides: Sides,
    below: u32,
    family: u8,
) -> Result<u8> {
    if stream.code(contexts.single(sides, below), family.count_ones() == 1)? {
        let mut child = 0;
        for axis in (0..3).rev() {
            let bit = stream.code(contexts.octant(sides, below, axis, child), family & HALVES[axis] != 0)?;
            child |= u8::from(bit) << axis;
        }
        return Ok(1 << child);
    }
    let mut known = 0_u8;
    for child in 0..8 {
        // Of two children or more, the last ones may be certain.
        let certain = known.count_ones() + (8 - child) == 2;
        let bit = certain
            || stream.code(contexts.child(sides, below, child as usize, known), family >> child & 1 == 1)?;
        known |= u8::from(bit) << child;
    }
    Ok(known)
}

/// For each axis, the children in its upper half.
const HALVES: [u8; 3] = [0b1010_1010, 0b1100_1100, 0b1111_0000];

/// No such node.
const NONE: u32 = u32::MAX;

/// The nodes of a level, ascending, each with the places of its face neighbors: `2 axis + forward`.
struct Level {
    codes: Vec<u64>,
    sides: Vec<[u32; 6]>,
}

impl Level {
    fn root() -> Self {
        Self { codes: vec![0], sides: vec![[NONE; 6]] }
    }

    /// The next level. A child's neighbor is its sibling or a child of its parent's neighbor, so that none is
    /// searched for.
    fn children(&self, families: &[u8]) -> Self {
        let mut starts = Vec::with_capacity(families.len());
        let mut count = 0_u32;
        for family in families {
            starts.push(count);
            count += family.count_ones();
        }
        let place = |node: u32, child: u32| match families.get(node as usize) {
            Some(family) if family >> child & 1 == 1 => {
                starts[node as usize] + (family & ((1 << child) - 1)).count_ones()
            }
            _ => NONE,
        };
        let mut next =
            Self { codes: Vec::with_capacity(count as usize), sides: Vec::with_capacity(count as usize) };
        for (node, (code, sides)) in self.codes.iter().zip(&self.sides).enumerate() {
            for child in (0..8_u32).filter(|child| families[node] >> child & 1 == 1) {
                next.codes.push(code << 3 | u64::from(child));
                next.sides.push(std::array::from_fn(|side| {
                    let (axis, forward) = (side / 2, side as u32 & 1);
                    let leaves = child >> axis & 1 == forward;
                    place(if leaves { sides[side] } else { node as u32 }, child ^ 1 << axis)
                }));
            }
        }
        next
    }
}

/// Which of a node's six face neighbors exist: bit `2 axis + forward`.
#[derive(Clone, Copy)]
struct Sides(u8);

impl Sides {
    fn of(places: &[u32; 6]) -> Self {
        Self(places.iter().zip(0..).fold(0, |bits, (place, side)| bits | u8::from(*place != NONE) << side))
    }

    /// How many of the three neighbors that touch `child` exist.
    fn touching(self, child: usize) -> usize {
        (0..3).filter(|axis| self.0 >> (2 * axis + (child >> axis & 1)) & 1 == 1).count()
    }

    /// How many of the three neighbors on the far side from `child` exist.
    fn opposite(self, child: usize) -> usize {
        self.touching(!child & 7)
    }

    /// Whether the two neighbors along `axis` exist.
    fn along(self, axis: usize) -> usize {
        usize::from(self.0 >> (2 * axis) & 3)
    }
}

/// Levels above the cells that have contexts of their own.
const HEIGHTS: usize = 8;

/// The adaptive bits of the three kinds of decisions.
struct PositionContexts {
    single: Vec<AdaptiveBit>,
    octant: Vec<AdaptiveBit>,
    child: Vec<AdaptiveBit>,
}

impl PositionContexts {
    fn new() -> Self {
        Self {
            single: vec![AdaptiveBit::NEW; HEIGHTS * 7],
            octant: vec![AdaptiveBit::NEW; 3 * 8 * 4 * 3],
            child: vec![AdaptiveBit::NEW; 2 * 8 * 4 * 4 * 4 * 4],
        }
    }

    /// Whether a node has one child only: by height and number of neighbors.
    fn single(&mut self, sides: Sides, below: u32) -> &mut AdaptiveBit {
        &mut self.single[(below as usize).min(HEIGHTS - 1) * 7 + sides.0.count_ones() as usize]
    }

    /// Which half of an axis an only child is in, by the halves of the axes before it and the axis' neighbors.
    fn octant(&mut self, sides: Sides, below: u32, axis: usize, upper: u8) -> &mut AdaptiveBit {
        let digits = [(usize::from(upper), 8), (sides.along(axis), 4), (axis, 3)];
        &mut self.octant
            [digits.iter().fold((below as usize).min(2), |place, (digit, base)| place * base + digit)]
    }

    /// Whether a child exists: by its place, known siblings, those across a face, and neighbors.
    fn child(&mut self, sides: Sides, below: u32, child: usize, known: u8) -> &mut AdaptiveBit {
        let beside =
            (0..3).filter(|axis| child >> axis & 1 == 1 && known >> (child ^ 1 << axis) & 1 == 1).count();
        let siblings = (known.count_ones() as usize).min(3);
        let digits = [siblings, beside, sides.opposite(child), sides.touching(child)];
        let place = digits.iter().fold(usize::from(below == 0) * 8 + child, |place, digit| place * 4 + digit);
        &mut self.child[place]
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn round_trip(cells: &[[i32; 3]]) -> (Vec<[i32; 3]>, usize) {
        let ordered = order(cells).expect("cells fit");
        let expected: Vec<[i32; 3]> = ordered.order.iter().map(|index| cells[*index]).collect();
        let section = encode(&ordered);
        assert_eq!(decode(&section, cells.len()).expect("decodes"), expected);
        (expected, section.len())
    }

    #[test]
    fn extremes_come_back() {
        round_trip(&[[0, 0, 0]]);
        round_trip(&[[i32::MIN; 3]]);
        round_trip(&[[i32::MAX; 3]]);
        round_trip(&[[i32::MIN, 5, -7], [i32::MIN + (1 << 21) - 1, 5, -7]]);
        round_trip(&[[i32::MAX - (1 << 21) + 1, 0, 0], [i32::MAX, 0, 0]]);
        let dense: Vec<[i32; 3]> =
            (0..4096).map(|code| morton::deinterleave(code).map(|c| c as i32 - 8)).collect();
        assert!(round_trip(&dense).1 < 100, "a full cube is nearly free");
    }

    #[test]
    fn cells_too_far_apart_and_cells_given_twice_are_refused() {
        assert!(matches!(order(&[[0; 3], [1 << 21, 0, 0]]), Err(EncodeError::TooLarge { .. })));
        let (what, value, limit) = ("cells along one axis", 1 << 32, 1 << 21);
        assert_eq!(order(&[[i32::MIN; 3], [i32::MAX; 3]]), Err(EncodeError::TooLarge { what, value, limit }));
        assert_eq!(order(&[[1; 3], [2; 3], [1; 3]]), Err(EncodeError::DuplicateCell { cell: [1; 3] }));
        assert_eq!(order(&[]), Err(EncodeError::Empty));
    }

    #[test]
    fn a_wrong_count_or_a_cell_beyond_i32_is_refused() {
        let section = encode(&order(&[[0, 0, 0], [3, 4, 5]]).expect("cells fit"));
        assert!(decode(&section, 1).is_err());
        assert!(decode(&section, 3).is_err());
        let mut writer = Writer::new();
        [i64::from(i32::MAX), 0, 0].iter().for_each(|low| writer.signed(*low));
        writer.u8(1);
        writer.raw(&section[4..]);
        assert!(decode(&writer.into_bytes(), 2).is_err());
    }

    #[test]
    fn cells_beyond_i32_are_refused_on_every_axis() {
        // A node with its last child alone in every level: four ones each.
        let with_least = |min: [i64; 3], depth: u8| {
            let mut section = Writer::new();
            min.iter().for_each(|low| section.signed(*low));
            section.u8(depth);
            let mut stream = StreamEncoder::new();
            let (mut contexts, mut level) = (PositionContexts::new(), Level::root());
            for below in (0..u32::from(depth)).rev() {
                let sides = Sides::of(&level.sides[0]);
                code_family(&mut stream, &mut contexts, sides, below, 1 << 7).expect("an encoder");
                level = level.children(&[1 << 7]);
            }
            section.raw(&stream.finish());
            decode(&section.into_bytes(), 1)
        };
        let max = i64::from(i32::MAX);
        for depth in [0, 1, 21] {
            let last = max - (1 << depth) + 1;
            assert_eq!(with_least([last; 3], depth), Ok(vec![[i32::MAX; 3]]));
            for axis in 0..3 {
                for wrong in [last + 1, i64::from(i32::MIN) - 1, i64::MAX] {
                    let mut min = [0; 3];
                    min[axis] = wrong;
                    let error = with_least(min, depth).expect_err("must be refused");
                    assert!(error.to_string().contains("least cell"), "{error}");
                }
            }
        }
        let error = with_least([0; 3], 22).expect_err("must be refused");
        assert!(error.to_string().contains("depth is 22"), "{error}");
    }

    #[test]
    fn no_section_holds_more_anchors_than_its_likeliest_decisions() {
        let likeliest = -libm::log2(1.0 - 32.0 / 65_536.0);
        for length in [0, 1, 100, 1 << 30] {
            // A stream may leave out up to four bytes of zeros.
            let max = 8.0 * (length as f64 + 4.0) / likeliest;
            let bound = max_anchors_exclusive(length) as f64;
            assert!((max..1.01 * max).contains(&bound), "{bound} anchors, {max} decisions");
        }
    }

    #[test]
    fn a_surface_takes_few_bits_an_anchor() {
        // The shell of a sphere of radius 60 cells, as trained anchors lie on surfaces.
        let mut cells = Vec::new();
        for x in -64_i32..64 {
            for y in -64_i32..64 {
                for z in -64_i32..64 {
                    let square = x * x + y * y + z * z;
                    if (3600..3700).contains(&square) {
                        cells.push([x, y, z]);
                    }
                }
            }
        }
        let (_, bytes) = round_trip(&cells);
        let bits = 8.0 * bytes as f64 / cells.len() as f64;
        println!("{} cells, {bits:.3} bits each", cells.len());
        assert!(bits < 2.6, "{bits} bits a cell");
    }

    #[test]
    fn neighbors_are_what_a_search_finds() {
        let cells: Vec<[i32; 3]> = (0..4096_u64)
            .filter(|code| code * code % 11 < 4)
            .map(|code| morton::deinterleave(code).map(|c| c as i32))
            .collect();
        let ordered = order(&cells).expect("cells fit");
        let mut level = Level::root();
        for families in families(&ordered) {
            level = level.children(&families);
            let nodes: Vec<[i64; 3]> =
                level.codes.iter().map(|code| morton::deinterleave(*code).map(i64::from)).collect();
            for (node, sides) in nodes.iter().zip(&level.sides) {
                for (side, place) in sides.iter().enumerate() {
                    let mut beside = *node;
                    beside[side / 2] += 2 * (side as i64 % 2) - 1;
                    let expected = nodes.iter().position(|other| *other == beside);
                    assert_eq!(expected, (*place != NONE).then_some(*place as usize));
                }
            }
        }
        assert_eq!(level.codes, ordered.codes);
    }

    proptest! {
        #[test]
        fn any_cells_come_back(cells in prop::collection::hash_set(prop::array::uniform3(-40_i32..40), 1..200)) {
            let cells: Vec<_> = cells.into_iter().collect();
            round_trip(&cells);
        }
    }
}
