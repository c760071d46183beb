//! Anchor cells as an occupancy octree, level by level from the root, with adaptive binary contexts.
//!
//! The nodes of a level are known in full before their children are coded, so a child's context can look at
//! the nodes on the outer sides of its parent. The last level is the cells in Morton order.

use super::{
    adaptive::AdaptiveBit,
    bytes::{Reader, Writer},
    error::{DecodeError, EncodeError},
    morton::{self, AXIS_BITS},
    range::{StreamDecoder, StreamEncoder},
};

const PART: &str = "positions";

/// Cells of a scene in the order of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Ordered {
    /// Least coordinate on each axis.
    pub(super) least: [i32; 3],
    /// Octree levels: coordinates relative to `least` are below 2^depth.
    pub(super) depth: u32,
    /// Morton codes of the relative coordinates, ascending.
    pub(super) codes: Vec<u64>,
    /// `order[i]` is the index in the input of the cell that comes `i`-th.
    pub(super) order: Vec<usize>,
}

/// Sorts cells into the order of a file.
pub(super) fn order(cells: &[[i32; 3]]) -> Result<Ordered, EncodeError> {
    let bound = |axis: usize, pick: fn(i32, i32) -> i32| cells.iter().map(|cell| cell[axis]).reduce(pick);
    let mut least = [0; 3];
    let mut widest = 0;
    for (axis, least) in least.iter_mut().enumerate() {
        let (Some(low), Some(high)) = (bound(axis, i32::min), bound(axis, i32::max)) else {
            return Err(EncodeError::Empty);
        };
        *least = low;
        widest = widest.max(high.abs_diff(low));
    }
    if widest >> AXIS_BITS != 0 {
        return Err(EncodeError::TooLarge {
            what: "cells along one axis",
            value: u64::from(widest) + 1,
            limit: 1 << AXIS_BITS,
        });
    }
    let code = |cell: &[i32; 3]| morton::interleave([0, 1, 2].map(|axis| cell[axis].abs_diff(least[axis])));
    let mut sorted: Vec<(u64, usize)> = cells.iter().map(code).zip(0..).collect();
    sorted.sort_unstable();
    if let Some(pair) = sorted.windows(2).find(|pair| pair[0].0 == pair[1].0) {
        return Err(EncodeError::DuplicateCell { cell: cells[pair[0].1] });
    }
    let (codes, order) = sorted.into_iter().unzip();
    Ok(Ordered { least, depth: u32::BITS - widest.leading_zeros(), codes, order })
}

/// The positions section.
pub(super) fn encode(cells: &Ordered) -> Vec<u8> {
    let mut writer = Writer::new();
    cells.least.iter().for_each(|low| writer.signed(i64::from(*low)));
    writer.u8(cells.depth as u8);
    let mut stream = StreamEncoder::new();
    let mut contexts = Contexts::new();
    for level in 0..cells.depth {
        let below = 3 * (cells.depth - 1 - level);
        let mut children: Vec<u64> = cells.codes.iter().map(|code| code >> below).collect();
        children.dedup();
        let families: Vec<&[u64]> = children.chunk_by(|a, b| a >> 3 == b >> 3).collect();
        let parents: Vec<u64> = families.iter().map(|family| family[0] >> 3).collect();
        for (index, family) in families.iter().enumerate() {
            let sides = Sides::of(&parents, index, level);
            let occupied = family.iter().fold(0_u8, |bits, child| bits | 1 << (child & 7));
            let mut known = 0_u8;
            for child in 0..8 {
                if child == 7 && known == 0 {
                    break; // A node has a child: the last one is certain.
                }
                let bit = occupied >> child & 1 == 1;
                let leaf = level + 1 == cells.depth;
                stream.adaptive(contexts.of(child, known, sides, leaf), bit);
                known |= u8::from(bit) << child;
            }
        }
    }
    writer.raw(&stream.finish());
    writer.into_bytes()
}

/// Reads the positions section of a file with `count` anchors, in file order.
pub(super) fn decode(section: &[u8], count: usize) -> Result<Vec<[i32; 3]>, DecodeError> {
    let mut reader = Reader::new(PART, section);
    let mut least = [0_i64; 3];
    for low in &mut least {
        *low = reader.signed("least cell")?;
    }
    let depth = u32::from(reader.u8("depth")?);
    let wide = (1_i64 << depth.min(AXIS_BITS)) - 1;
    let fits = |low: &i64| i32::try_from(*low).is_ok() && i32::try_from(low.saturating_add(wide)).is_ok();
    if depth > AXIS_BITS {
        return Err(reader.malformed("depth", depth));
    }
    let mut stream = StreamDecoder::new(PART, reader.rest())?;
    let mut contexts = Contexts::new();
    let mut nodes = vec![0_u64];
    for level in 0..depth {
        let leaf = level + 1 == depth;
        let mut children = Vec::new();
        for index in 0..nodes.len() {
            let sides = Sides::of(&nodes, index, level);
            let mut known = 0_u8;
            for child in 0..8 {
                let certain = child == 7 && known == 0;
                if certain || stream.adaptive(contexts.of(child, known, sides, leaf))? {
                    known |= 1 << child;
                    children.push(nodes[index] << 3 | child as u64);
                }
            }
            if children.len() > count {
                return Err(reader.malformed("number of cells", format!("over the stated {count}")));
            }
        }
        nodes = children;
    }
    stream.finish()?;
    if nodes.len() != count {
        return Err(reader.malformed("number of cells", format!("{} where {count} are stated", nodes.len())));
    }
    let cell = |code: &u64| {
        let relative = morton::deinterleave(*code);
        [0, 1, 2].map(|axis| least[axis] + i64::from(relative[axis]))
    };
    if !least.iter().all(fits) {
        return Err(reader.malformed("least cell", format!("{least:?}")));
    }
    Ok(nodes.iter().map(|code| cell(code).map(|coordinate| coordinate as i32)).collect())
}

/// Which of a node's six face neighbours exist: bit `2 axis + forward`.
#[derive(Clone, Copy)]
struct Sides(u8);

impl Sides {
    fn of(nodes: &[u64], index: usize, level: u32) -> Self {
        let mut sides = 0;
        for axis in 0..3 {
            for forward in [false, true] {
                let there = morton::neighbour(nodes[index], axis, forward, level);
                if there.is_some_and(|code| nodes.binary_search(&code).is_ok()) {
                    sides |= 1 << (2 * axis + usize::from(forward));
                }
            }
        }
        Self(sides)
    }

    /// How many of the three neighbours that touch `child` exist.
    fn touching(self, child: usize) -> usize {
        (0..3).filter(|axis| self.0 >> (2 * axis + (child >> axis & 1)) & 1 == 1).count()
    }

    /// How many of the three neighbours on the far side from `child` exist.
    fn opposite(self, child: usize) -> usize {
        self.touching(!child & 7)
    }
}

/// A probability for each combination of child, known siblings and neighbours, apart for the last level.
struct Contexts(Vec<AdaptiveBit>);

impl Contexts {
    fn new() -> Self {
        Self(vec![AdaptiveBit::NEW; 2 * 8 * 4 * 4 * 4 * 4])
    }

    fn of(&mut self, child: usize, known: u8, sides: Sides, leaf: bool) -> &mut AdaptiveBit {
        let beside =
            (0..3).filter(|axis| child >> axis & 1 == 1 && known >> (child ^ 1 << axis) & 1 == 1).count();
        let siblings = (known.count_ones() as usize).min(3);
        let digits = [siblings, beside, sides.opposite(child), sides.touching(child)];
        let place = digits.iter().fold(usize::from(leaf) * 8 + child, |place, digit| place * 4 + digit);
        &mut self.0[place]
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
        assert!(matches!(order(&[[i32::MIN; 3], [i32::MAX; 3]]), Err(EncodeError::TooLarge { .. })));
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

    proptest! {
        #[test]
        fn any_cells_come_back(cells in prop::collection::hash_set(prop::array::uniform3(-40_i32..40), 1..200)) {
            let cells: Vec<_> = cells.into_iter().collect();
            round_trip(&cells);
        }
    }
}
