//! Exclusive prefix sums on the device.
//!
//! Sums saturate at `u32::MAX`. The result does not depend on subgroups or scheduling. The number of dispatches is constant, and
//! the count is read on the device.

use std::sync::Arc;

use super::{AdapterReport, Buffer, Kernel, Plan, Recorder, kernel_source, planned};

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ScanParams {
    runs: u32,
    count_index: u32,
    capacity: u32,
    total_index: u32,
}

/// Which elements hold the count and receive the total.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScanSlots {
    /// Element of the count buffer that says how many values there are (capped by the values' length).
    pub count: u32,
    /// Element of the totals buffer that receives their saturating sum.
    pub total: u32,
}

/// A prefix sum over up to `capacity` values.
#[derive(Debug)]
pub struct Scan {
    reduce: Arc<Kernel>,
    scan: Arc<Kernel>,
    apply: Arc<Kernel>,
    params: Buffer<ScanParams>,
    partials: Buffer<u32>,
    groups: u32,
}

impl Scan {
    /// Plans the scan.
    #[must_use]
    pub fn plan(adapter: &AdapterReport, capacity: usize, slots: ScanSlots) -> Plan<'static, Self> {
        let runs: u32 = adapter.variant.choose(512, 8192);
        let params = ScanParams {
            runs,
            count_index: slots.count,
            capacity: u32::try_from(capacity).unwrap_or(u32::MAX),
            total_index: slots.total,
        };
        planned!(Self {
            reduce: Plan::kernel(kernel_source!("scan_reduce"), &[]),
            scan: Plan::kernel(kernel_source!("scan_partials"), &[]),
            apply: Plan::kernel(kernel_source!("scan_apply"), &[]),
            params: Plan::upload("scan params", vec![params]),
            partials: Plan::buffer("scan partials", runs as usize),
            groups: Plan::value(runs.div_ceil(32)),
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
        let (params, partials) = (&self.params, &self.partials);
        recorder.dispatch(&self.reduce, &[params, counts, values, partials], self.groups);
        recorder.dispatch(&self.scan, &[params, partials, totals], 1);
        recorder.dispatch(&self.apply, &[params, counts, values, partials, sums], self.groups);
    }
}
