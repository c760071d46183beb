//! Plans: what a constructor will allocate on the device, known before it runs.
//!
//! What always holds: the bytes of a plan are those of exactly the buffers that [`Plan::make`] makes, since both come from the
//! same calls. Memory estimates, limits of adapters and allocation therefore cannot differ.

use std::{borrow::Cow, fmt, sync::Arc};

use super::{Buffer, Device, GpuError, Kernel, KernelSource, buffer_bytes};

type Constructor<'a, T> = dyn FnOnce(&Device) -> Result<T, GpuError> + 'a;

/// A value whose buffers are not made yet.
pub struct Plan<'a, T> {
    bytes: u64,
    largest: u64,
    make: Box<Constructor<'a, T>>,
}

impl<'a, T: 'a> Plan<'a, T> {
    fn new(bytes: u64, make: impl FnOnce(&Device) -> Result<T, GpuError> + 'a) -> Self {
        Self { bytes, largest: bytes, make: Box::new(make) }
    }

    /// A value that takes no memory on the device.
    #[must_use]
    pub fn value(value: T) -> Self {
        Self::new(0, |_| Ok(value))
    }

    /// Bytes of all buffers.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Bytes of the largest buffer.
    #[must_use]
    pub fn largest_bytes(&self) -> u64 {
        self.largest
    }

    /// Makes the value with its buffers.
    ///
    /// # Errors
    /// As [`Device::buffer`] and [`Device::kernel`].
    pub fn make(self, device: &Device) -> Result<T, GpuError> {
        (self.make)(device)
    }

    /// Both values. The macro `planned!` joins the plans of a struct's fields.
    #[must_use]
    pub fn and<U: 'a>(self, other: Plan<'a, U>) -> Plan<'a, (T, U)> {
        Plan {
            bytes: self.bytes.saturating_add(other.bytes),
            largest: self.largest.max(other.largest),
            make: Box::new(|device| Ok((self.make(device)?, other.make(device)?))),
        }
    }

    /// What `map` makes of the value.
    #[must_use]
    pub fn map<U: 'a>(self, map: impl FnOnce(T) -> U + 'a) -> Plan<'a, U> {
        let (bytes, largest) = (self.bytes, self.largest);
        Plan { bytes, largest, make: Box::new(|device| Ok(map(self.make(device)?))) }
    }

    /// The values of all plans, in order.
    #[must_use]
    pub fn all(plans: impl IntoIterator<Item = Self>) -> Plan<'a, Vec<T>> {
        let plans: Vec<Self> = plans.into_iter().collect();
        Plan {
            bytes: plans.iter().fold(0, |sum, plan| sum.saturating_add(plan.bytes)),
            largest: plans.iter().map(|plan| plan.largest).max().unwrap_or(0),
            make: Box::new(|device| plans.into_iter().map(|plan| plan.make(device)).collect()),
        }
    }
}

impl<'a, T: bytemuck::Pod> Plan<'a, Buffer<T>> {
    /// A buffer of `len` zeroed elements.
    #[must_use]
    pub fn buffer(label: &'static str, len: usize) -> Self {
        Self::new(buffer_bytes::<T>(len), move |device| device.buffer(label, len))
    }

    /// A buffer of `len` elements, which is `old` where that has room, whatever it holds, and else a new one, zeroed.
    #[must_use]
    pub fn resized(label: &'static str, len: usize, old: Option<&'a Buffer<T>>) -> Self {
        Self::new(buffer_bytes::<T>(len), move |device| {
            old.and_then(|old| old.with_len(len)).map_or_else(|| device.buffer(label, len), Ok)
        })
    }

    /// A buffer that holds `values`.
    #[must_use]
    pub fn upload(label: &'static str, values: impl Into<Cow<'a, [T]>>) -> Self {
        let values = values.into();
        Self::new(buffer_bytes::<T>(values.len()), move |device| device.upload(label, &values))
    }
}

impl<'a> Plan<'a, Arc<Kernel>> {
    /// A compiled kernel.
    #[must_use]
    pub fn kernel(source: KernelSource, defs: &[(&'static str, u32)]) -> Self {
        let defs = defs.to_vec();
        Self::new(0, move |device| device.kernel(source, &defs))
    }
}

impl<T> fmt::Debug for Plan<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Plan").field("bytes", &self.bytes).finish_non_exhaustive()
    }
}

/// The plan of a struct from the plans of its fields, in the order in which they are made:
/// `planned!(Self { capacity: Plan::value(8), rows: Plan::buffer("rows", 8) })`.
#[macro_export]
macro_rules! planned {
    (@fields $plan:expr, $pattern:pat, $kind:ident { $($done:ident)* }) => {
        $plan.map(move |$pattern| $kind { $($done),* })
    };
    (@fields $plan:expr, $pattern:pat, $kind:ident { $($done:ident)* } $field:ident: $next:expr, $($rest:tt)*) => {
        $crate::gpu::planned!(@fields $plan.and($next), ($pattern, $field), $kind { $($done)* $field } $($rest)*)
    };
    (@fields $plan:expr, $pattern:pat, $kind:ident { $($done:ident)* } $field:ident: $next:expr) => {
        $crate::gpu::planned!(@fields $plan.and($next), ($pattern, $field), $kind { $($done)* $field })
    };
    ($kind:ident { $($fields:tt)* }) => {
        $crate::gpu::planned!(@fields $crate::gpu::Plan::value(()), (), $kind {} $($fields)*)
    };
}

pub use planned;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::lavapipe;

    #[derive(Debug)]
    struct Rows {
        count: usize,
        values: Buffer<f32>,
        parts: Vec<Buffer<u32>>,
    }

    #[test]
    fn a_plan_counts_the_bytes_that_it_allocates() {
        let plan = || {
            planned!(Rows {
                count: Plan::value(100),
                values: Plan::buffer("values", 100),
                parts: Plan::all([1, 5].map(|len| Plan::upload("part", vec![7; len]))),
            })
        };
        assert_eq!((plan().bytes(), plan().largest_bytes()), (400 + 16 + 32, 400));
        let device = lavapipe();
        let made = plan().make(&device).expect("room");
        assert_eq!(device.allocated_bytes(), plan().bytes());
        assert_eq!((made.count, made.values.len()), (100, 100));
        assert_eq!(device.read(&made.parts[1]).expect("read"), [7; 5]);
    }

    #[test]
    fn a_buffer_with_room_is_kept_and_a_larger_one_is_made() {
        let device = lavapipe();
        let mut buffer = device.upload("kept", &[1_u32, 2, 3, 4, 5, 6, 7, 8]).expect("room");
        let (made, bytes) = (device.buffers_made(), device.allocated_bytes());
        for len in [3, 8, 0, 1] {
            buffer = Plan::resized("kept", len, Some(&buffer)).make(&device).expect("has room");
            assert_eq!(buffer.len(), len);
        }
        assert_eq!((device.buffers_made(), device.allocated_bytes()), (made, bytes));
        let buffer = Plan::resized("kept", 9, Some(&buffer)).make(&device).expect("room");
        assert_eq!(device.buffers_made(), made + 1);
        assert_eq!(device.read(&buffer).expect("read"), [0; 9]);
    }
}
