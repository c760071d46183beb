//! Exclusive prefix sums on the device.
//!
//! Sums saturate at `u32::MAX`. The result does not depend on subgroups or scheduling, no workgroup waits for another, and the count
//! is read on the device.

use std::sync::Arc;

use super::{AdapterReport, BLOCK, Buffer, Kernel, KernelVariant, Plan, Recorder, kernel_source, planned};

/// Which elements hold the count and receive the total.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScanSlots {
    /// Element of the count buffer that says how many values there are (capped by the values' length).
    pub count: u32,
    /// Element of the totals buffer that receives their saturating sum.
    pub total: u32,
}

/// Runs of the software's kernels, one invocation each.
const RUNS: u32 = 512;

#[derive(Debug)]
enum Kernels {
    /// Each invocation has a contiguous run: sums of the runs, their prefix sums in one workgroup, prefix sums of all values.
    Software { reduce: Arc<Kernel>, scan: Arc<Kernel>, apply: Arc<Kernel> },
    /// Each workgroup has a block: sums of the blocks, prefix sums of all values.
    Hardware { reduce: Arc<Kernel>, apply: Arc<Kernel> },
}

impl Kernels {
    fn plan(variant: KernelVariant) -> Plan<'static, Self> {
        let kernel = |source| Plan::kernel(source, &[]);
        match variant {
            KernelVariant::Software => kernel(kernel_source!("scan_reduce"))
                .and(kernel(kernel_source!("scan_partials")))
                .and(kernel(kernel_source!("scan_apply")))
                .map(|((reduce, scan), apply)| Self::Software { reduce, scan, apply }),
            KernelVariant::Hardware => kernel(kernel_source!("scan_block_sums"))
                .and(kernel(kernel_source!("scan_blocks")))
                .map(|(reduce, apply)| Self::Hardware { reduce, apply }),
        }
    }
}

/// A prefix sum over up to `capacity` values.
#[derive(Debug)]
pub struct Scan {
    kernels: Kernels,
    /// `ScanParams` of the variant's kernels.
    params: Buffer<[u32; 4]>,
    partials: Buffer<u32>,
    groups: u32,
}

impl Scan {
    /// Plans the scan.
    #[must_use]
    pub fn plan(adapter: &AdapterReport, capacity: usize, slots: ScanSlots) -> Plan<'static, Self> {
        let capacity_u32 = u32::try_from(capacity).unwrap_or(u32::MAX);
        let blocks = capacity_u32.div_ceil(BLOCK as u32).max(1);
        let (params, groups, partials) = adapter.variant.choose(
            ([RUNS, slots.count, capacity_u32, slots.total], RUNS.div_ceil(32), RUNS as usize),
            // The first partial sum is the number of values.
            ([slots.count, capacity_u32, slots.total, 0], blocks, 1 + blocks as usize),
        );
        planned!(Self {
            kernels: Kernels::plan(adapter.variant),
            params: Plan::upload("scan params", vec![params]),
            partials: Plan::buffer("scan partials", partials),
            groups: Plan::value(groups),
        })
    }

    /// Records `sums[i] = values[0] + ... + values[i - 1]` and the total.
    /// `counts` and `totals` may be one buffer.
    pub fn record(
        &self,
        recorder: &mut Recorder<'_>,
        counts: &Buffer<u32>,
        values: &Buffer<u32>,
        sums: &Buffer<u32>,
        totals: &Buffer<u32>,
    ) {
        let (params, partials, groups) = (&self.params, &self.partials, self.groups);
        match &self.kernels {
            Kernels::Software { reduce, scan, apply } => {
                recorder.dispatch(reduce, &[params, counts, values, partials], groups);
                recorder.dispatch(scan, &[params, partials, totals], 1);
                recorder.dispatch(apply, &[params, counts, values, partials, sums], groups);
            }
            Kernels::Hardware { reduce, apply } => {
                recorder.dispatch(reduce, &[params, counts, values, partials], groups);
                recorder.dispatch(apply, &[params, values, partials, sums, totals], groups);
            }
        }
    }
}
