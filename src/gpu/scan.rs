//! Exclusive prefix sums on the device.
//!
//! What always holds: sums saturate at `u32::MAX`; the result does not depend on subgroups or on scheduling; the
//! number of dispatches is constant, and the count is read on the device.

use std::sync::Arc;

use super::{AdapterReport, Buffer, Device, GpuError, Kernel, Recorder, buffer_bytes, kernel_source};

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
    fn runs(adapter: &AdapterReport) -> u32 {
        adapter.variant.choose(512, 8192)
    }

    /// Bytes on the device.
    #[must_use]
    pub fn bytes(adapter: &AdapterReport) -> u64 {
        buffer_bytes::<ScanParams>(1) + buffer_bytes::<u32>(Self::runs(adapter) as usize)
    }

    /// Prepares the scan.
    ///
    /// # Errors
    /// As [`Device::buffer`] and [`Device::kernel`].
    pub fn new(device: &Device, capacity: usize, slots: ScanSlots) -> Result<Self, GpuError> {
        let runs = Self::runs(device.adapter());
        let params = ScanParams {
            runs,
            count_index: slots.count,
            capacity: u32::try_from(capacity).unwrap_or(u32::MAX),
            total_index: slots.total,
        };
        Ok(Self {
            reduce: device.kernel(kernel_source!("scan_reduce"), &[])?,
            scan: device.kernel(kernel_source!("scan_partials"), &[])?,
            apply: device.kernel(kernel_source!("scan_apply"), &[])?,
            params: device.upload("scan params", &[params])?,
            partials: device.buffer("scan partials", runs as usize)?,
            groups: runs.div_ceil(32),
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
        let (params, partials) = (self.params.as_ref(), self.partials.as_ref());
        recorder.dispatch(&self.reduce, &[params, counts.as_ref(), values.as_ref(), partials], self.groups);
        recorder.dispatch(&self.scan, &[params, partials, totals.as_ref()], 1);
        recorder.dispatch(
            &self.apply,
            &[params, counts.as_ref(), values.as_ref(), partials, sums.as_ref()],
            self.groups,
        );
    }
}
