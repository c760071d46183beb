//! Stable least-significant-digit radix sort on the device.
//!
//! What always holds: the result is the same on every adapter, no order depends on atomics or subgroups, no workgroup waits for
//! another, and the count is read on the device. Each pass counts digits, turns the counts into places, and moves the pairs.
//!
//! Software adapters give each invocation a contiguous run of keys and its own counters, without barriers (`sort_count`,
//! `sort_offsets`, `sort_scatter`). Hardware gives each workgroup a block of keys, which it sorts in its own memory, so that
//! neighboring lanes read and write neighboring places (`radix_histogram`, `radix_scan`, `radix_scatter`).

use std::sync::Arc;

use super::{
    AdapterReport, BLOCK, Binding, Buffer, Device, GpuError, Kernel, KernelSource, KernelVariant, Plan,
    Recorder, kernel_source, planned,
};

/// Parameters of a pass.
#[derive(Debug, Clone, Copy, Default)]
struct SortParams {
    /// Runs of the software's kernels; hardware derives its blocks from the count.
    runs: Option<u32>,
    count_index: u32,
    capacity: u32,
    shift: u32,
    digits: u32,
}

/// Keys with the values that they carry.
#[derive(Debug, Clone)]
pub struct Pairs {
    /// Sorted by these.
    pub keys: Buffer<u32>,
    /// Carried along.
    pub values: Buffer<u32>,
}

impl Pairs {
    /// Plans `capacity` pairs.
    #[must_use]
    pub fn plan(capacity: usize) -> Plan<'static, Self> {
        planned!(Self {
            keys: Plan::buffer("sort keys", capacity),
            values: Plan::buffer("sort values", capacity),
        })
    }
}

/// The passes of a sort by `bits` bits.
#[derive(Debug)]
struct DigitPasses {
    bits: u32,
    /// Of each pass, its uniform and its digits.
    params: Vec<(Buffer<u32>, u32)>,
}

/// How a variant's kernels divide the keys.
#[derive(Debug, Clone, Copy)]
struct Division {
    /// Parts with counters of their own: runs of one invocation each, or blocks.
    parts: u32,
    /// Parts of a workgroup.
    parts_a_group: u32,
    /// Digits whose counters one workgroup turns into places.
    digits_a_group: u32,
    /// Bits of the widest pass.
    widest: u32,
}

/// A sort of up to `capacity` pairs by the low bits of their keys.
#[derive(Debug)]
pub struct RadixSort {
    count: Arc<Kernel>,
    offsets: Arc<Kernel>,
    scatter: Arc<Kernel>,
    division: Division,
    /// One for each number of bits so far; the last is in use.
    passes: Vec<DigitPasses>,
    counters: Buffer<u32>,
    totals: Buffer<u32>,
    /// The parameters that all passes share.
    sort: SortParams,
}

impl Division {
    /// Software adapters have few lanes and pay for each dispatch: wide digits and few runs, the fastest of 32 to 1024 runs by
    /// 4 to 11 bits on lavapipe.
    fn of(adapter: &AdapterReport, capacity: usize) -> Self {
        let blocks = u32::try_from(capacity.div_ceil(BLOCK)).unwrap_or(u32::MAX).max(1);
        adapter.variant.choose(
            Self { parts: 128, parts_a_group: 16, digits_a_group: 16, widest: 8 },
            Self { parts: blocks, parts_a_group: 1, digits_a_group: 1, widest: 8 },
        )
    }

    /// The kernels that count, turn counts into places, and move.
    fn kernels(adapter: &AdapterReport) -> [KernelSource; 3] {
        adapter.variant.choose(
            [kernel_source!("sort_count"), kernel_source!("sort_offsets"), kernel_source!("sort_scatter")],
            [
                kernel_source!("radix_histogram"),
                kernel_source!("radix_scan"),
                kernel_source!("radix_scatter"),
            ],
        )
    }
}

impl SortParams {
    /// The division's part of the parameters.
    fn of(adapter: &AdapterReport, division: Division) -> Self {
        Self { runs: adapter.variant.choose(Some(division.parts), None), ..Self::default() }
    }

    /// `SortParams` as the kernels of the variant read it, padded to a multiple of 16 bytes.
    fn words(self) -> Vec<u32> {
        let mut words: Vec<u32> = self.runs.into_iter().collect();
        words.extend([self.count_index, self.capacity, self.shift, self.digits]);
        words.resize(words.len().next_multiple_of(4), 0);
        words
    }

    /// Plans the passes of a sort by the lowest `bits` bits.
    fn passes(self, widest: u32, bits: u32) -> Plan<'static, DigitPasses> {
        let mut shift = 0;
        let params = widths(bits.min(32), widest).into_iter().map(|width| {
            let params = Self { shift, digits: 1 << width, ..self };
            shift += width;
            Plan::upload("sort params", params.words()).map(move |buffer| (buffer, params.digits))
        });
        Plan::all(params).map(move |params| DigitPasses { bits, params })
    }
}

/// Bits of each pass, lowest first: as few passes as `widest` allows, of equal width or one less.
fn widths(bits: u32, widest: u32) -> Vec<u32> {
    let passes = bits.div_ceil(widest);
    (0..passes).map(|pass| bits / passes + u32::from(pass < bits % passes)).collect()
}

impl RadixSort {
    /// Plans a sort by the lowest `bits` bits (at most 32); element `count_index` of the count buffer holds the number of pairs.
    #[must_use]
    pub fn plan(
        adapter: &AdapterReport,
        capacity: usize,
        bits: u32,
        count_index: u32,
    ) -> Plan<'static, Self> {
        let division = Division::of(adapter, capacity);
        let sort = SortParams {
            capacity: u32::try_from(capacity).unwrap_or(u32::MAX),
            count_index,
            ..SortParams::of(adapter, division)
        };
        let [count, offsets, scatter] = Division::kernels(adapter);
        planned!(Self {
            count: Plan::kernel(count, &[]),
            offsets: Plan::kernel(offsets, &[]),
            scatter: Plan::kernel(scatter, &[]),
            division: Plan::value(division),
            passes: Plan::all([sort.passes(division.widest, bits)]),
            counters: Plan::buffer("sort counters", (division.parts as usize) << division.widest),
            totals: Plan::buffer("sort totals", 1 << division.widest),
            sort: Plan::value(sort),
        })
    }

    /// Bytes on the device that [`RadixSort::set_bits`] adds for a new number of bits.
    #[must_use]
    pub fn pass_bytes(adapter: &AdapterReport, bits: u32) -> u64 {
        let division = Division::of(adapter, 0);
        SortParams::of(adapter, division).passes(division.widest, bits).bytes()
    }

    /// Sorts by another number of bits from the next recording on.
    ///
    /// # Errors
    /// As [`Device::buffer`], for a new number.
    pub fn set_bits(&mut self, device: &Device, bits: u32) -> Result<(), GpuError> {
        let passes = match self.passes.iter().position(|passes| passes.bits == bits) {
            Some(known) => self.passes.remove(known),
            None => self.sort.passes(self.division.widest, bits).make(device)?,
        };
        self.passes.push(passes);
        Ok(())
    }

    /// Whether the result is in the spare pairs: after an odd number of passes.
    #[must_use]
    pub fn ends_in_spare(&self) -> bool {
        self.passes.last().is_some_and(|passes| passes.params.len() % 2 == 1)
    }

    /// Records the sort and says which of the two holds the result: `pairs`, or `spare` after an odd number of passes.
    #[must_use]
    pub fn record<'p>(
        &self,
        recorder: &mut Recorder<'_>,
        counts: &Buffer<u32>,
        pairs: &'p Pairs,
        spare: &'p Pairs,
    ) -> &'p Pairs {
        let (mut from, mut to) = (pairs, spare);
        let Division { parts, parts_a_group, digits_a_group, .. } = self.division;
        let groups = parts.div_ceil(parts_a_group);
        for (params, digits) in self.passes.last().into_iter().flat_map(|passes| &passes.params) {
            let (params, counters, totals) = (params, &self.counters, &self.totals);
            recorder.dispatch(&self.count, &[params, counts, &from.keys, counters], groups);
            let offsets: &[Binding<'_>] = match recorder.variant() {
                KernelVariant::Software => &[params, counters, totals],
                KernelVariant::Hardware => &[params, counts, counters, totals],
            };
            recorder.dispatch(&self.offsets, offsets, digits.div_ceil(digits_a_group));
            recorder.dispatch(
                &self.scatter,
                &[params, counts, totals, counters, &from.keys, &from.values, &to.keys, &to.values],
                groups,
            );
            (from, to) = (to, from);
        }
        from
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_cover_all_bits_in_as_few_passes_as_allowed() {
        assert_eq!(widths(0, 8), Vec::<u32>::new());
        assert_eq!(widths(6, 8), [6]);
        assert_eq!(widths(9, 8), [5, 4]);
        assert_eq!(widths(32, 8), [8; 4]);
        assert_eq!(widths(32, 4), [4; 8]);
    }
}
