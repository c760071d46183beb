//! Stable least-significant-digit radix sort on the device.
//!
//! Each invocation owns a contiguous run of keys and its own counters, so the sort needs no subgroups, no atomics and
//! no barriers, and its result is the same on every adapter. The count is read on the device.

use std::sync::Arc;

use super::{AdapterReport, Buffer, Device, GpuError, Kernel, Recorder, buffer_bytes, kernel_source};

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct SortParams {
    runs: u32,
    count_index: u32,
    capacity: u32,
    shift: u32,
    digits: u32,
    unused: [u32; 3],
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
    /// Bytes on the device.
    #[must_use]
    pub fn bytes(capacity: usize) -> u64 {
        2 * buffer_bytes::<u32>(capacity)
    }

    /// Room for `capacity` pairs.
    ///
    /// # Errors
    /// As [`Device::buffer`].
    pub fn new(device: &Device, capacity: usize) -> Result<Self, GpuError> {
        Ok(Self {
            keys: device.buffer("sort keys", capacity)?,
            values: device.buffer("sort values", capacity)?,
        })
    }
}

/// The passes of a sort by so many bits.
#[derive(Debug)]
struct DigitPasses {
    bits: u32,
    /// What each pass is given, and its digits.
    params: Vec<(Buffer<SortParams>, u32)>,
}

/// A sort of up to `capacity` pairs by the low bits of their keys.
#[derive(Debug)]
pub struct RadixSort {
    count: Arc<Kernel>,
    offsets: Arc<Kernel>,
    scatter: Arc<Kernel>,
    /// One for each number of bits that was asked for; the current one is the last.
    passes: Vec<DigitPasses>,
    counters: Buffer<u32>,
    totals: Buffer<u32>,
    runs: u32,
    count_index: u32,
    capacity: u32,
}

/// Bits of each pass, lowest first: as few passes as `widest` allows, of equal width or one less.
fn widths(bits: u32, widest: u32) -> Vec<u32> {
    let passes = bits.div_ceil(widest);
    (0..passes).map(|pass| bits / passes + u32::from(pass < bits % passes)).collect()
}

impl RadixSort {
    /// Runs, and the bits of the widest pass. Software adapters have few lanes and pay for each dispatch: wide digits and few
    /// runs, the best of 32 to 1024 runs by 4 to 11 bits on lavapipe. Hardware wants many runs.
    fn runs_and_widest(adapter: &AdapterReport) -> (u32, u32) {
        adapter.variant.choose((128, 8), (1024, 4))
    }

    /// Bytes on the device of a sort by the lowest `bits` bits, besides the pairs.
    #[must_use]
    pub fn bytes(adapter: &AdapterReport, bits: u32) -> u64 {
        let (runs, widest) = Self::runs_and_widest(adapter);
        Self::pass_bytes(adapter, bits)
            + buffer_bytes::<u32>((runs as usize) << widest)
            + buffer_bytes::<u32>(1 << widest)
    }

    /// Bytes on the device of what [`RadixSort::set_bits`] adds for a number of bits that is new.
    #[must_use]
    pub fn pass_bytes(adapter: &AdapterReport, bits: u32) -> u64 {
        let (_, widest) = Self::runs_and_widest(adapter);
        widths(bits.min(32), widest).len() as u64 * buffer_bytes::<SortParams>(1)
    }

    /// Prepares a sort by the lowest `bits` bits (at most 32); `count_index` is the element of the count buffer that
    /// says how many pairs there are.
    ///
    /// # Errors
    /// As [`Device::buffer`] and [`Device::kernel`].
    pub fn new(device: &Device, capacity: usize, bits: u32, count_index: u32) -> Result<Self, GpuError> {
        let (runs, widest) = Self::runs_and_widest(device.adapter());
        let mut sort = Self {
            count: device.kernel(kernel_source!("sort_count"), &[])?,
            offsets: device.kernel(kernel_source!("sort_offsets"), &[])?,
            scatter: device.kernel(kernel_source!("sort_scatter"), &[])?,
            passes: Vec::new(),
            counters: device.buffer("sort counters", (runs as usize) << widest)?,
            totals: device.buffer("sort totals", 1 << widest)?,
            runs,
            count_index,
            capacity: u32::try_from(capacity).unwrap_or(u32::MAX),
        };
        sort.set_bits(device, bits)?;
        Ok(sort)
    }

    /// Sorts by another number of bits from the next recording on.
    ///
    /// # Errors
    /// As [`Device::buffer`], where that number is new.
    pub fn set_bits(&mut self, device: &Device, bits: u32) -> Result<(), GpuError> {
        let passes = match self.passes.iter().position(|passes| passes.bits == bits) {
            Some(known) => self.passes.remove(known),
            None => self.new_digit_passes(device, bits)?,
        };
        self.passes.push(passes);
        Ok(())
    }

    fn new_digit_passes(&self, device: &Device, bits: u32) -> Result<DigitPasses, GpuError> {
        let (runs, widest) = Self::runs_and_widest(device.adapter());
        let mut passes = DigitPasses { bits, params: Vec::new() };
        let mut shift = 0;
        for width in widths(bits.min(32), widest) {
            let params = SortParams {
                runs,
                count_index: self.count_index,
                capacity: self.capacity,
                shift,
                digits: 1 << width,
                unused: [0; 3],
            };
            passes.params.push((device.upload("sort params", &[params])?, params.digits));
            shift += width;
        }
        Ok(passes)
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
        let groups = self.runs.div_ceil(16);
        for (params, digits) in self.passes.last().into_iter().flat_map(|passes| &passes.params) {
            let (params, counters, totals) = (params.as_ref(), self.counters.as_ref(), self.totals.as_ref());
            recorder.dispatch(&self.count, &[params, counts.as_ref(), from.keys.as_ref(), counters], groups);
            recorder.dispatch(&self.offsets, &[params, counters, totals], digits.div_ceil(16));
            recorder.dispatch(
                &self.scatter,
                &[
                    params,
                    counts.as_ref(),
                    totals,
                    counters,
                    from.keys.as_ref(),
                    from.values.as_ref(),
                    to.keys.as_ref(),
                    to.values.as_ref(),
                ],
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
