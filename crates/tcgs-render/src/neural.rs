//! Neural Gaussians on the device: from anchors and a camera to the Gaussians of a view, and their gradients back to the
//! anchors' rows and the networks' parameters (METHOD.md §2.2, §2.3).
//!
//! Every anchor is visible at most once in a view and owns its rows, so gradients are stored, never added concurrently, and the
//! same input gives the same bits.

use std::sync::Arc;

use bytemuck::Zeroable;

use super::{
    Activation, AnchorGradients, Columns, DenseLayers, DeviceAnchors, GaussianGradients, Gaussians,
    InputGradient, Rasterizer, RenderError, Result, WeightGradient, projection::CenteredPose,
};
use crate::{
    domain::{Camera, SceneScale},
    gpu::{
        AdapterReport, BLOCK, Buffer, Device, Kernel, KernelVariant, Plan, Recorder, kernel_source, planned,
    },
    model::{ModelShape, NetworkLayout},
};

/// More anchors than any adapter can hold; sums of their bytes stay far below the range of integers.
const MAX_ANCHORS: usize = 1 << (usize::BITS / 2 + 4);

/// `View` of `shaders/shared/anchor_view.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ViewUniform {
    rows: [[f32; 4]; 3],
    center: [f32; 4],
    intrinsics: [f32; 4],
    image: [f32; 4],
    counts: [u32; 4],
}

#[derive(Debug)]
struct Kernels {
    anchor_visible: Arc<Kernel>,
    compaction: Compaction,
    network_input: Arc<Kernel>,
    opaque_anchors: Arc<Kernel>,
    opaque_input: Arc<Kernel>,
    visible_offsets: Arc<Kernel>,
    dense: DenseLayers,
    spawn_gaussians: Arc<Kernel>,
    count_gaussians: Arc<Kernel>,
    spawn_gradient: Arc<Kernel>,
    feature_gradient: Arc<Kernel>,
    anchor_statistics: Arc<Kernel>,
}

impl Kernels {
    fn new(device: &Device, shape: ModelShape, subgroups: Option<u32>) -> Result<Self> {
        let defs = shape.defs();
        let of_view = [defs.as_slice(), &[("VIEW_DEGREE", u32::from(shape.view_degree.get()))]].concat();
        let opaque = [of_view.as_slice(), &[("OPAQUE", 1)]].concat();
        let input = kernel_source!("network_input");
        Ok(Self {
            anchor_visible: device.kernel(kernel_source!("anchor_visible"), &defs)?,
            compaction: Compaction::new(device)?,
            network_input: device.kernel(input, &of_view)?,
            opaque_anchors: device.kernel(kernel_source!("opaque_anchors"), &defs)?,
            opaque_input: device.kernel(input, &opaque)?,
            visible_offsets: device.kernel(kernel_source!("visible_offsets"), &defs)?,
            dense: DenseLayers::new(device, subgroups, NetworkLayout::new(shape).layers())?,
            spawn_gaussians: device.kernel(kernel_source!("spawn_gaussians"), &defs)?,
            count_gaussians: device.kernel(kernel_source!("count_gaussians"), &defs)?,
            spawn_gradient: device.kernel(kernel_source!("spawn_gradient"), &defs)?,
            feature_gradient: device.kernel(kernel_source!("feature_gradient"), &defs)?,
            anchor_statistics: statistics_kernel(device, &defs)?,
        })
    }
}

fn statistics_kernel(device: &Device, defs: &[(&str, u32)]) -> Result<Arc<Kernel>> {
    Ok(device.kernel(kernel_source!("anchor_statistics"), defs)?)
}

/// The kernels that list the visible anchors.
#[derive(Debug)]
enum Compaction {
    /// One workgroup.
    Software(Arc<Kernel>),
    /// A workgroup for each block: counts of the blocks, then the list.
    Hardware { count: Arc<Kernel>, list: Arc<Kernel> },
}

impl Compaction {
    fn new(device: &Device) -> Result<Self> {
        Ok(match device.variant() {
            KernelVariant::Software => Self::Software(device.kernel(kernel_source!("compact_anchors"), &[])?),
            KernelVariant::Hardware => Self::Hardware {
                count: device.kernel(kernel_source!("count_visible_anchors"), &[])?,
                list: device.kernel(kernel_source!("list_visible_anchors"), &[])?,
            },
        })
    }

    /// Records listing the anchors whose flags are set, of the first `anchors`, into `list` behind their number.
    fn record(
        &self,
        recorder: &mut Recorder<'_>,
        view: &Buffer<ViewUniform>,
        flags: Flags<'_>,
        list: &Buffer<u32>,
        anchors: usize,
    ) {
        let Flags { visible, block_counts } = flags;
        match self {
            Self::Software(compact) => recorder.dispatch(compact, &[view, visible, list], 1),
            Self::Hardware { count, list: fill } => {
                let blocks = anchors.div_ceil(BLOCK).max(1) as u32;
                recorder.dispatch(count, &[view, visible, block_counts], blocks);
                recorder.dispatch(fill, &[view, visible, block_counts, list], blocks);
            }
        }
    }
}

/// Flags of anchors, and room for how many are set in each block of [`BLOCK`] anchors.
#[derive(Debug, Clone, Copy)]
struct Flags<'a> {
    visible: &'a Buffer<u32>,
    block_counts: &'a Buffer<u32>,
}

/// The anchors whose flags are set, ascending, as a view lists them. Waits for the device.
///
/// # Errors
/// Faults of the device.
pub fn list_visible(device: &Device, visible: &[bool]) -> Result<Vec<u32>> {
    let anchors = visible.len();
    let counts = [anchors as u32, anchors as u32, 0, 0];
    let view = device.upload("view", &[ViewUniform { counts, ..ViewUniform::zeroed() }])?;
    let flags: Vec<u32> = visible.iter().map(|flag| u32::from(*flag)).collect();
    let visible = device.upload("visible anchors", &flags)?;
    let block_counts = device.buffer("visible anchors of blocks", anchors.div_ceil(BLOCK))?;
    let list = device.buffer("visible list", anchors + 1)?;
    let mut recorder = device.recorder("visible anchors");
    let flags = Flags { visible: &visible, block_counts: &block_counts };
    Compaction::new(device)?.record(&mut recorder, &view, flags, &list, anchors);
    recorder.submit()?;
    let mut list = device.read(&list)?;
    let count = list.remove(0) as usize;
    list.truncate(count);
    Ok(list)
}

/// Activations of the forward pass, column-major with `capacity` columns: one for each visible anchor while opacities are
/// evaluated, and then for each that makes a Gaussian.
#[derive(Debug)]
struct Activations {
    /// Flags of the visible anchors, then of the opaque ones among them.
    visible: Buffer<u32>,
    /// Set flags of each block of [`BLOCK`] anchors.
    block_counts: Buffer<u32>,
    list: Buffer<u32>,
    /// The networks' columns, of the opaque anchors: how many, the place of each in the list, and its anchor.
    columns: Buffer<u32>,
    input: Buffer<f32>,
    hidden: Buffer<f32>,
    /// The networks' outputs; after a backward pass, the gradients by them.
    outputs: Buffer<f32>,
    alive: Buffer<u32>,
    gaussians: Gaussians,
}

impl Activations {
    fn flags(&self) -> Flags<'_> {
        Flags { visible: &self.visible, block_counts: &self.block_counts }
    }

    fn plan(layout: &NetworkLayout, capacity: usize) -> Plan<'static, Self> {
        planned!(Self {
            visible: Plan::buffer("visible anchors", capacity),
            block_counts: Plan::buffer("visible anchors of blocks", capacity.div_ceil(BLOCK)),
            list: Plan::buffer("visible list", capacity + 1),
            columns: Plan::buffer("columns of opaque anchors", 2 * capacity + 1),
            input: Plan::buffer("network input", layout.hidden.inputs * capacity),
            hidden: Plan::buffer("hidden values", layout.hidden.outputs * capacity),
            outputs: Plan::buffer("network output", layout.output_rows() * capacity),
            alive: Plan::buffer("living gaussians", capacity),
            gaussians: Gaussians::plan(capacity * layout.shape.offsets, 4),
        })
    }
}

/// Buffers of the backward pass; made when it is first recorded.
#[derive(Debug)]
struct Backward {
    d_input: Buffer<f32>,
    d_hidden: Buffer<f32>,
    partials: Buffer<f32>,
    d_gaussians: GaussianGradients,
}

impl Backward {
    fn plan(layout: &NetworkLayout, capacity: usize) -> Plan<'static, Self> {
        planned!(Self {
            d_input: Plan::buffer("gradients of input", layout.shape.features * capacity),
            d_hidden: Plan::buffer("gradients of hidden values", layout.hidden.outputs * capacity),
            partials: DenseLayers::partials(
                "partial weight gradients",
                capacity,
                layout.layers(),
                layout.parameters,
            ),
            d_gaussians: GaussianGradients::plan(capacity * layout.shape.offsets),
        })
    }
}

/// Turns anchors into the Gaussians of a view.
#[derive(Debug)]
pub struct NeuralGaussians {
    device: Arc<Device>,
    layout: NetworkLayout,
    kernels: Kernels,
    /// Of the last forward pass.
    view: ViewUniform,
    capacity: usize,
    forward: Activations,
    backward: Option<Backward>,
    /// Whether `forward.outputs` holds outputs, which a backward pass turns into gradients.
    holds_outputs: bool,
    near: f32,
    scene_scale: SceneScale,
}

impl NeuralGaussians {
    /// Prepares the kernels for a model of this shape. Views begin at `near`, in world units; networks get distances over
    /// `scene_scale`.
    pub fn new(device: Arc<Device>, shape: ModelShape, near: f32, scene_scale: SceneScale) -> Result<Self> {
        let subgroups = device.subgroups().lanes();
        Self::with_subgroups(device, shape, near, scene_scale, subgroups)
    }

    /// As [`NeuralGaussians::new`], with the kernels without subgroups, for adapters whose subgroups are broken.
    pub fn without_subgroups(
        device: Arc<Device>,
        shape: ModelShape,
        near: f32,
        scene_scale: SceneScale,
    ) -> Result<Self> {
        Self::with_subgroups(device, shape, near, scene_scale, None)
    }

    fn with_subgroups(
        device: Arc<Device>,
        shape: ModelShape,
        near: f32,
        scene_scale: SceneScale,
        subgroups: Option<u32>,
    ) -> Result<Self> {
        let layout = NetworkLayout::new(shape);
        Ok(Self {
            kernels: Kernels::new(&device, shape, subgroups)?,
            view: ViewUniform::zeroed(),
            capacity: 0,
            forward: Activations::plan(&layout, 0).make(&device)?,
            backward: None,
            holds_outputs: false,
            near,
            scene_scale,
            layout,
            device,
        })
    }

    /// Most anchors of a shape whose largest buffer the adapter binds: here, among the anchors' own and in the rasterizer, with the
    /// spare capacity of [`Self::forward`].
    #[must_use]
    pub fn max_anchors(adapter: &AdapterReport, shape: ModelShape) -> usize {
        let limit = adapter.max_binding_bytes.min(adapter.max_buffer_bytes);
        let layout = NetworkLayout::new(shape);
        let fits = |anchors: usize| {
            let capacity = Self::capacity(anchors);
            let largest = [
                DeviceAnchors::plan(shape, anchors).largest_bytes(),
                Activations::plan(&layout, capacity).largest_bytes(),
                Backward::plan(&layout, capacity).largest_bytes(),
                Rasterizer::largest_bytes(adapter, capacity * shape.offsets),
            ];
            largest.into_iter().all(|bytes| bytes <= limit)
        };
        // An anchor takes more than a byte in the largest buffer.
        let (mut max, mut too_many) = (0, usize::try_from(limit).unwrap_or(usize::MAX).min(MAX_ANCHORS));
        while too_many - max > 1 {
            let middle = max + (too_many - max) / 2;
            if fits(middle) {
                max = middle;
            } else {
                too_many = middle;
            }
        }
        max
    }

    /// Capacity of the buffers for views of `anchors` anchors: see [`Columns::capacity_for`].
    #[must_use]
    pub fn capacity(anchors: usize) -> usize {
        Columns::capacity_for(anchors)
    }

    /// Bytes on the device once views of `anchors` anchors were made and differentiated.
    #[must_use]
    pub fn bytes(shape: ModelShape, anchors: usize) -> u64 {
        let layout = NetworkLayout::new(shape);
        let capacity = Self::capacity(anchors);
        // Buffer sizes are rounded up, and each layer has a uniform.
        const ROUNDING: u64 = 1024;
        Activations::plan(&layout, capacity).bytes()
            + Backward::plan(&layout, capacity).bytes()
            + DenseLayers::bytes(layout.layers())
            + ROUNDING
    }

    /// The unit of the networks' distances.
    #[must_use]
    pub fn scene_scale(&self) -> SceneScale {
        self.scene_scale
    }

    /// The Gaussians of the last forward pass.
    #[must_use]
    pub fn gaussians(&self) -> &Gaussians {
        &self.forward.gaussians
    }

    /// The visible anchors of the last forward pass: how many, then their indices, ascending.
    #[must_use]
    pub fn visible_list(&self) -> &Buffer<u32> {
        &self.forward.list
    }

    /// Buffers for a loss's gradients by those Gaussians.
    ///
    /// # Errors
    /// Faults of the device on first use.
    pub fn gaussian_gradients(&mut self) -> Result<&GaussianGradients> {
        self.prepare_backward()?;
        self.backward.as_ref().map(|backward| &backward.d_gaussians).ok_or(RenderError::OutOfStep)
    }

    /// Candidate Gaussians, Gaussians of positive opacity, and visible anchors of the last submitted forward pass.
    pub fn counts(&self) -> Result<[u32; 3]> {
        let counts = self.device.read_range(&self.forward.gaussians.count, 0, 3)?;
        Ok([counts[0], counts[1], counts[2]])
    }

    /// The visible anchors of the last submitted forward pass, ascending, and the opacity of each of their offsets
    /// (0 where there is no Gaussian). Waits for the device.
    pub fn visible_opacities(&self) -> Result<(Vec<u32>, Vec<f32>)> {
        let count = self.device.read_range(&self.forward.list, 0, 1)?[0] as usize;
        let list = self.device.read_range(&self.forward.list, 1, count)?;
        let geometry = &self.forward.gaussians.geometry;
        let opacities = self.device.read_range(geometry, 0, count * self.layout.shape.offsets)?;
        Ok((list, opacities.iter().map(|gaussian| gaussian[3]).collect()))
    }

    /// Records the view's Gaussians. `volume_weight` is the regularizer's weight in the backward pass.
    ///
    /// # Errors
    /// Faults of the device, or a scene that is too large for it.
    pub fn forward(
        &mut self,
        recorder: &mut Recorder<'_>,
        anchors: &DeviceAnchors,
        camera: &Camera,
        volume_weight: f32,
    ) -> Result<()> {
        self.opacities(recorder, anchors, camera, volume_weight)?;
        self.holds_outputs = true;
        let (kernels, on) = (&self.kernels, &self.forward);
        let view = &recorder.uniform(&[self.view])?;
        let (dense, networks) = (&kernels.dense, &anchors.networks);
        let groups = anchors.count.div_ceil(64) as u32;
        // The opacities alone say which anchors need the rest.
        recorder.dispatch(
            &kernels.opaque_anchors,
            &[view, &on.list, &on.outputs, &anchors.masks, &on.visible, &on.gaussians.geometry, &on.alive],
            groups,
        );
        kernels.compaction.record(recorder, view, on.flags(), &on.columns, anchors.count);
        recorder.dispatch(
            &kernels.opaque_input,
            &[view, &on.list, &anchors.positions, &anchors.rows, &on.input, &on.columns],
            groups,
        );
        let columns = self.columns();
        let hidden = columns.layer(&self.layout.hidden);
        dense.forward(recorder, hidden, networks, &on.input, &on.hidden, Activation::Relu)?;
        for head in &self.layout.heads {
            let head = columns.layer(head);
            dense.forward(recorder, head, networks, &on.hidden, &on.outputs, Activation::Linear)?;
        }
        recorder.dispatch(
            &kernels.spawn_gaussians,
            &[
                view,
                &on.columns,
                &anchors.positions,
                &anchors.rows,
                &on.outputs,
                &anchors.masks,
                &on.gaussians.geometry,
                &on.gaussians.colors,
                &on.alive,
            ],
            groups,
        );
        recorder.dispatch(&kernels.count_gaussians, &[&on.list, &on.alive, &on.gaussians.count], 1);
        Ok(())
    }

    /// Records marking the offsets that the view can show in `shown`: bit k of an anchor's word is its offset k. Evaluates opacities
    /// alone, so there is nothing to render or to differentiate afterwards.
    ///
    /// # Errors
    /// As [`Self::forward`].
    pub fn visible_offsets(
        &mut self,
        recorder: &mut Recorder<'_>,
        anchors: &DeviceAnchors,
        camera: &Camera,
        shown: &Buffer<u32>,
    ) -> Result<()> {
        self.opacities(recorder, anchors, camera, 0.0)?;
        let on = &self.forward;
        let view = recorder.uniform(&[self.view])?;
        recorder.dispatch(
            &self.kernels.visible_offsets,
            &[&view, &on.list, &anchors.positions, &anchors.rows, &on.outputs, &anchors.masks, shown],
            anchors.count.div_ceil(64) as u32,
        );
        Ok(())
    }

    /// Records the opacities' outputs of the visible anchors.
    fn opacities(
        &mut self,
        recorder: &mut Recorder<'_>,
        anchors: &DeviceAnchors,
        camera: &Camera,
        volume_weight: f32,
    ) -> Result<()> {
        self.fit(anchors.count)?;
        self.holds_outputs = false;
        self.view = self.view_uniform(anchors.count, camera, volume_weight);
        // Offsets are small beside a far anchor's position, which the kernel therefore takes relative to the camera.
        self.forward.gaussians.origin = CenteredPose::of(camera).eye;
        let (kernels, on) = (&self.kernels, &self.forward);
        let view = &recorder.uniform(&[self.view])?;
        let groups = anchors.count.div_ceil(64) as u32;
        recorder.dispatch(
            &kernels.anchor_visible,
            &[view, &anchors.positions, &anchors.rows, &on.visible],
            groups,
        );
        kernels.compaction.record(recorder, view, on.flags(), &on.list, anchors.count);
        recorder.dispatch(
            &kernels.network_input,
            &[view, &on.list, &anchors.positions, &anchors.rows, &on.input],
            groups,
        );
        let (dense, networks) = (&kernels.dense, &anchors.networks);
        dense.load(recorder, networks);
        let [opacity, ..] = &self.layout.heads;
        let visible = Columns { list: &on.list, capacity: self.capacity };
        let hidden = visible.layer(&self.layout.hidden).first_outputs(opacity.inputs);
        dense.forward(recorder, hidden, networks, &on.input, &on.hidden, Activation::Relu)?;
        let opacity = visible.layer(opacity);
        dense.forward(recorder, opacity, networks, &on.hidden, &on.outputs, Activation::Linear)?;
        Ok(())
    }

    /// Records the gradients by rows and networks from those by the Gaussians of the last forward pass. Once per forward pass,
    /// since gradients overwrite the networks' outputs.
    ///
    /// # Errors
    /// [`RenderError::OutOfStep`] without a forward pass since the last backward pass; faults of the device.
    pub fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        anchors: &DeviceAnchors,
        out: &AnchorGradients,
    ) -> Result<()> {
        if !std::mem::take(&mut self.holds_outputs) {
            return Err(RenderError::OutOfStep);
        }
        self.prepare_backward()?;
        let back = self.backward.as_ref().ok_or(RenderError::OutOfStep)?;
        let (kernels, on) = (&self.kernels, &self.forward);
        let view = &recorder.uniform(&[self.view])?;
        let groups = anchors.count.div_ceil(64) as u32;
        recorder.clear(&out.rows);
        recorder.dispatch(
            &kernels.spawn_gradient,
            &[
                view,
                &on.columns,
                &on.gaussians.count,
                &anchors.rows,
                &on.gaussians.geometry,
                &back.d_gaussians.geometry,
                &back.d_gaussians.colors,
                &on.outputs,
                &out.rows,
            ],
            groups,
        );
        let (dense, columns, networks) = (&kernels.dense, self.columns(), &anchors.networks);
        let (parameters, partials) = (self.layout.parameters, &back.partials);
        let by_weights = WeightGradient { parameters, partials, sums: &out.networks };
        for head in &self.layout.heads {
            let layer = columns.layer(head);
            dense.weight_gradient(recorder, layer, &on.hidden, &on.outputs, by_weights)?;
            let d_hidden =
                InputGradient { rows: head.inputs, relu: Some(&on.hidden), buffer: &back.d_hidden };
            dense.input_gradient(recorder, layer, networks, &on.outputs, d_hidden)?;
        }
        let hidden = columns.layer(&self.layout.hidden);
        dense.weight_gradient(recorder, hidden, &on.input, &back.d_hidden, by_weights)?;
        // Of the inputs, view direction and distance need no gradient.
        let d_input = InputGradient { rows: self.layout.shape.features, relu: None, buffer: &back.d_input };
        dense.input_gradient(recorder, hidden, networks, &back.d_hidden, d_input)?;
        dense.finish_weight_gradients(recorder, columns, by_weights)?;
        recorder.dispatch(&kernels.feature_gradient, &[view, &on.columns, &back.d_input, &out.rows], groups);
        Ok(())
    }

    /// From now on, a view that gives an offset no gradient is not among those that the statistics count for it: masks hide all that
    /// the view shows of it.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn count_views_with_gradient(&mut self) -> Result<()> {
        let defs: Vec<_> = self.layout.shape.defs().iter().copied().chain([("MASKED", 1)]).collect();
        self.kernels.anchor_statistics = statistics_kernel(&self.device, &defs)?;
        Ok(())
    }

    /// Records adding the view to the growth statistics, `[N][2 K + 2]` (METHOD.md §2.6); does nothing if `overflow_flag` is set
    /// when it runs.
    ///
    /// # Errors
    /// [`RenderError::OutOfStep`] before a backward pass.
    pub fn statistics(
        &self,
        recorder: &mut Recorder<'_>,
        anchors: &DeviceAnchors,
        statistics: &Buffer<f32>,
        overflow_flag: &Buffer<u32>,
    ) -> Result<()> {
        let back = self.backward.as_ref().ok_or(RenderError::OutOfStep)?;
        let view = recorder.uniform(&[self.view])?;
        recorder.dispatch(
            &self.kernels.anchor_statistics,
            &[
                &view,
                &self.forward.list,
                &self.forward.gaussians.geometry,
                &back.d_gaussians.means2d,
                statistics,
                overflow_flag,
            ],
            anchors.count.div_ceil(64) as u32,
        );
        Ok(())
    }

    fn fit(&mut self, anchors: usize) -> Result<()> {
        if anchors > self.capacity {
            let capacity = Self::capacity(anchors);
            self.backward = None;
            self.forward = Activations::plan(&self.layout, capacity).make(&self.device)?;
            self.capacity = capacity;
        }
        Ok(())
    }

    fn prepare_backward(&mut self) -> Result<()> {
        if self.backward.is_none() {
            self.backward = Some(Backward::plan(&self.layout, self.capacity).make(&self.device)?);
        }
        Ok(())
    }

    fn view_uniform(&self, anchors: usize, camera: &Camera, volume_weight: f32) -> ViewUniform {
        let pose = CenteredPose::of(camera);
        let k = &camera.intrinsics;
        ViewUniform {
            rows: pose.rows,
            center: pose.eye_and(self.scene_scale.length().recip()),
            intrinsics: [k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32],
            image: [k.width as f32, k.height as f32, self.near, volume_weight],
            counts: [anchors as u32, self.capacity as u32, 0, 0],
        }
    }

    fn columns(&self) -> Columns<'_> {
        Columns { list: &self.forward.columns, capacity: self.capacity }
    }
}
