//! Bind groups that are kept from one recording to the next: making one costs the host as much as recording a dispatch.
//!
//! What always holds: a kept bind group refers only to buffers that still have a handle; it goes with the first of them that ends, and
//! its memory with it.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

use super::Kernel;

/// Most bindings of a kernel: a uniform and the storage buffers that every device binds.
const MAX_BINDINGS: usize = 10;

/// Bind groups kept at most; with more, all are dropped. A step of training has some hundred.
const MAX_KEPT: usize = 4096;

/// What a bind group is made of: the kernel, then each buffer with the part of it that is bound.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Key {
    kernel: u64,
    bindings: [(u64, u64, u64); MAX_BINDINGS],
}

/// The bind groups of a device.
#[derive(Debug, Default)]
pub(super) struct BindGroups {
    kept: Mutex<HashMap<Key, wgpu::BindGroup>>,
    next_id: AtomicU64,
}

impl BindGroups {
    /// A number that no other buffer or kernel of the device has.
    pub(super) fn next_id(&self) -> u64 {
        1 + self.next_id.fetch_add(1, Ordering::Relaxed)
    }

    /// The bind group of `kernel` with `parts`, the n-th at `@binding(n)`.
    pub(super) fn get(
        &self,
        device: &wgpu::Device,
        kernel: &Kernel,
        parts: &[BoundPart<'_>],
    ) -> wgpu::BindGroup {
        let make = || {
            let entries: Vec<_> = parts
                .iter()
                .zip(0..)
                .map(|(part, binding)| wgpu::BindGroupEntry { binding, resource: part.resource.clone() })
                .collect();
            let layout = &kernel.layout;
            let label = Some(kernel.name);
            device.create_bind_group(&wgpu::BindGroupDescriptor { label, layout, entries: &entries })
        };
        if parts.len() > MAX_BINDINGS {
            return make();
        }
        let mut key = Key { kernel: kernel.id, bindings: [(0, 0, 0); MAX_BINDINGS] };
        for (place, part) in key.bindings.iter_mut().zip(parts) {
            *place = part.key;
        }
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(group) = kept.get(&key) {
            return group.clone();
        }
        if kept.len() >= MAX_KEPT {
            kept.clear();
        }
        for part in parts {
            part.identity.is_kept.store(true, Ordering::Relaxed);
        }
        let group = make();
        kept.insert(key, group.clone());
        group
    }

    /// Drops the bind groups with the buffer of that number.
    pub(super) fn drop_with(&self, buffer: u64) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.retain(|key, _| key.bindings.iter().all(|(id, ..)| *id != buffer));
    }

    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner).len()
    }
}

/// A buffer, or a part of one, as a kernel binds it.
pub(super) struct BoundPart<'a> {
    /// The buffer's number, where the part begins, and its bytes.
    pub(super) key: (u64, u64, u64),
    pub(super) resource: wgpu::BindingResource<'a>,
    pub(super) identity: &'a Identity,
}

/// A buffer's number, which ends with its last handle, and the bind groups with it.
#[derive(Debug)]
pub(super) struct Identity {
    pub(super) id: u64,
    groups: Arc<BindGroups>,
    /// Whether bind groups with the buffer may be kept.
    is_kept: AtomicBool,
}

impl Identity {
    pub(super) fn new(groups: &Arc<BindGroups>) -> Self {
        Self { id: groups.next_id(), groups: Arc::clone(groups), is_kept: false.into() }
    }
}

impl Drop for Identity {
    fn drop(&mut self) {
        if *self.is_kept.get_mut() {
            self.groups.drop_with(self.id);
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::gpu::{KernelSource, testing::lavapipe};

    const ADD: KernelSource = KernelSource {
        name: "add",
        text: "@group(0) @binding(0) var<uniform> more: vec4u;\n\
               @group(0) @binding(1) var<storage, read_write> values: array<u32>;\n\
               @compute @workgroup_size(64) fn add(@builtin(global_invocation_id) id: vec3u) {\n\
               if id.x < arrayLength(&values) { values[id.x] += more.x; } }",
    };

    #[test]
    fn a_kept_bind_group_reads_the_constants_of_its_own_recording() {
        let device = lavapipe();
        let kernel = device.kernel(ADD, &[]).expect("compiles");
        let values = device.upload("values", &[0_u32; 4]).expect("room");
        for more in [1_u32, 10, 100] {
            let mut recorder = device.recorder("add");
            for factor in [1, 2] {
                let uniform = recorder.uniform(&[[factor * more, 0, 0, 0]]).expect("room");
                recorder.dispatch(&kernel, &[&uniform, &values], 1);
            }
            recorder.submit().expect("submitted");
        }
        assert_eq!(device.read(&values).expect("read"), [333; 4]);
        assert_eq!(device.bind_groups.len(), 2, "one for each place of a constant");
    }

    #[test]
    fn bind_groups_end_with_a_buffer_of_theirs() {
        let device = lavapipe();
        let kernel = device.kernel(ADD, &[]).expect("compiles");
        let record = |values: &crate::gpu::Buffer<u32>| {
            let mut recorder = device.recorder("add");
            let uniform = recorder.uniform(&[[1, 0, 0, 0]]).expect("room");
            recorder.dispatch(&kernel, &[&uniform, values], 1);
            recorder.submit().expect("submitted");
        };
        let kept = device.upload("kept", &[0_u32; 4]).expect("room");
        record(&kept);
        let dropped = device.upload("dropped", &[0_u32; 4]).expect("room");
        let same = dropped.first(2);
        record(&dropped);
        assert_eq!(device.bind_groups.len(), 2);
        drop(dropped);
        assert_eq!(device.bind_groups.len(), 2, "another handle is left");
        drop(same);
        assert_eq!(device.bind_groups.len(), 1);
    }

    #[test]
    fn recordings_of_several_threads_have_constants_of_their_own() {
        let device = lavapipe();
        let kernel = device.kernel(ADD, &[]).expect("compiles");
        std::thread::scope(|scope| {
            for thread in 1..=4_u32 {
                let (device, kernel) = (&device, &kernel);
                scope.spawn(move || {
                    let values = device.upload("values", &[0_u32; 4]).expect("room");
                    for _ in 0..50 {
                        let mut recorder = device.recorder("add");
                        let uniform = recorder.uniform(&[[thread, 0, 0, 0]]).expect("room");
                        recorder.dispatch(kernel, &[&uniform, &values], 1);
                        recorder.submit().expect("submitted");
                    }
                    assert_eq!(device.read(&values).expect("read"), [50 * thread; 4]);
                });
            }
        });
    }
}
