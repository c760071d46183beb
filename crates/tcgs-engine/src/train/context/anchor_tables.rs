//! The context model's tables of anchors: their positions on the planes, their neighbors, and the inverse tables, by which gradients
//! are gathered.
//!
//! Tables follow from the cells by the codec's integer arithmetic, so training samples exactly where a decoder does. The host
//! rebuilds them whenever the set of anchors changes.

use super::ContextConfig;
use crate::{
    codec::context::{Texel, coordinates, neighbors, position_inputs, texels},
    domain::{
        ContextFrame,
        context_model::{NEIGHBORS, POSITION_INPUTS},
    },
    gpu::{Buffer, Device, GpuError, Plan, planned},
    train::ContextError,
};

/// Largest number of anchors: an index shares a 32-bit word with a neighbor slot.
const MAX_ANCHORS: usize = 1 << 30;

/// The tables in the kernels' layout; empty for models without planes.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ContextAnchors {
    /// Anchors.
    pub count: usize,
    /// `[N][18]`: the position prior.
    pub priors: Vec<f32>,
    /// `[N][3]`: the position on each plane, a byte each from the lowest: x, y, fractions along x and y in 256ths.
    pub texels: Vec<u32>,
    /// `[N][K]`: the anchors whose planes are sampled, itself first.
    pub neighbors: Vec<u32>,
}

impl ContextAnchors {
    /// The anchors at `cells`.
    #[must_use]
    pub fn new(config: &ContextConfig, frame: &ContextFrame, cells: &[[i32; 3]]) -> Self {
        let coordinates = coordinates(frame, cells);
        let priors = coordinates
            .iter()
            .flat_map(|coordinate| position_inputs(*coordinate))
            .map(|prior| f32::from(prior) / 256.0)
            .collect();
        let sampled = config.kind.sampled();
        let mut anchors = Self { count: cells.len(), priors, ..Self::default() };
        if sampled == 0 {
            return anchors;
        }
        anchors.texels = coordinates
            .iter()
            .flat_map(|coordinate| texels(*coordinate, config.planes.edge))
            .map(pack)
            .collect();
        anchors.neighbors = if sampled == 1 {
            (0..cells.len() as u32).collect()
        } else {
            neighbors(cells).iter().flat_map(|nearest| nearest[..sampled].to_vec()).collect()
        };
        anchors
    }

    /// Checks that kernels cannot read outside their buffers with these tables.
    ///
    /// # Errors
    /// [`ContextError::Anchors`] names the entry that is out of range.
    pub fn check(&self, config: &ContextConfig) -> Result<(), ContextError> {
        let sampled = config.kind.sampled();
        let length = |what: &str, found: usize, width: usize| {
            if found == width * self.count {
                return Ok(());
            }
            Err(ContextError::Anchors(format!("{found} {what} of {} anchors", self.count)))
        };
        length("values of position priors", self.priors.len(), POSITION_INPUTS)?;
        length("texels", self.texels.len(), if sampled > 0 { 3 } else { 0 })?;
        length("neighbors", self.neighbors.len(), sampled)?;
        if self.count >= MAX_ANCHORS {
            return Err(ContextError::Anchors(format!("{} anchors are too many", self.count)));
        }
        if let Some(stray) = self.neighbors.iter().find(|anchor| **anchor as usize >= self.count) {
            return Err(ContextError::Anchors(format!("neighbor {stray} of {} anchors", self.count)));
        }
        let outside = |texel: &&u32| {
            let [x, y, ..] = texel.to_le_bytes();
            usize::from(x.max(y)) >= config.planes.edge
        };
        match self.texels.iter().find(outside) {
            Some(texel) => Err(ContextError::Anchors(format!("texel {texel:08x} is outside its plane"))),
            None => Ok(()),
        }
    }

    /// Anchors with positions on planes: all or none.
    fn placed(&self) -> usize {
        self.texels.len() / 3
    }

    /// The inverse of the neighbor table, as offsets and lists: for each anchor, those that have it as a neighbor. An entry is
    /// four times the other anchor's index plus the neighbor slot; entries ascend.
    #[must_use]
    pub fn users(&self) -> (Vec<u32>, Vec<u32>) {
        let sampled = self.neighbors.len() / self.count.max(1);
        let entries = self.neighbors.iter().enumerate().map(|(place, anchor)| {
            let (user, slot) = (place / sampled, place % sampled);
            (*anchor as usize, (NEIGHBORS * user + slot) as u32)
        });
        lists(self.placed(), entries)
    }

    /// For each texel of the three planes of this edge, as offsets and lists: the anchors whose samples use it, ascending, each
    /// with the bits of its weight. Zero weights are left out.
    #[must_use]
    pub fn plane_users(&self, edge: usize) -> (Vec<u32>, Vec<[u32; 2]>) {
        let entries = self.texels.iter().enumerate().flat_map(|(place, texel)| {
            let (anchor, plane) = (place / 3, place % 3);
            let [x, y, fx, fy] = texel.to_le_bytes().map(usize::from);
            let (right, below) = ((x + 1).min(edge - 1), (y + 1).min(edge - 1));
            let corners = [
                (x, y, (256 - fx) * (256 - fy)),
                (right, y, fx * (256 - fy)),
                (x, below, (256 - fx) * fy),
                (right, below, fx * fy),
            ];
            corners.into_iter().filter(|(.., weight)| *weight > 0).map(move |(x, y, weight)| {
                // Exact: at most 17 bits over a power of two.
                let weight = weight as f32 / 65_536.0;
                ((plane * edge + y) * edge + x, [anchor as u32, weight.to_bits()])
            })
        });
        lists(3 * edge * edge, entries)
    }
}

fn pack(texel: Texel) -> u32 {
    // An edge is at most 256, so each is a byte.
    u32::from_le_bytes([texel.x0, texel.y0, texel.fx, texel.fy].map(|value| value as u8))
}

/// Groups entries by their keys below `keys`, stably: offsets of each key's list and its end, and the entries.
fn lists<T: Copy + Default>(
    keys: usize,
    entries: impl Iterator<Item = (usize, T)> + Clone,
) -> (Vec<u32>, Vec<T>) {
    let mut starts = vec![0; keys + 1];
    let mut count = 0;
    for (key, _) in entries.clone() {
        starts[key + 1] += 1;
        count += 1;
    }
    for key in 0..keys {
        starts[key + 1] += starts[key];
    }
    let mut next = starts.clone();
    let mut sorted = vec![T::default(); count];
    for (key, entry) in entries {
        sorted[next[key] as usize] = entry;
        next[key] += 1;
    }
    (starts, sorted)
}

/// The tables on the device.
#[derive(Debug)]
pub(super) struct DeviceTables {
    pub(super) config: ContextConfig,
    pub(super) count: usize,
    pub(super) priors: Buffer<f32>,
    pub(super) texels: Buffer<u32>,
    pub(super) neighbors: Buffer<u32>,
    pub(super) user_starts: Buffer<u32>,
    pub(super) users: Buffer<u32>,
    pub(super) plane_starts: Buffer<u32>,
    pub(super) plane_users: Buffer<[u32; 2]>,
    /// The column of each anchor in the sample, or `NO_COLUMN`.
    pub(super) columns: Buffer<u32>,
}

impl DeviceTables {
    /// Plans the tables of `anchors` anchors whose samples use `plane_users` texels in all.
    fn plan(config: &ContextConfig, anchors: usize, plane_users: usize) -> Plan<'static, Self> {
        let sampled = config.kind.sampled();
        let (placed, edge) = if sampled > 0 { (anchors, config.planes.edge) } else { (0, 0) };
        planned!(Self {
            config: Plan::value(*config),
            count: Plan::value(anchors),
            priors: Plan::buffer("position priors", anchors * POSITION_INPUTS),
            texels: Plan::buffer("texels of anchors", 3 * placed),
            neighbors: Plan::buffer("neighbors", sampled * placed),
            user_starts: Plan::buffer("starts of users of anchors", placed + 1),
            users: Plan::buffer("users of anchors", sampled * placed),
            plane_starts: Plan::buffer("starts of users of texels", 3 * edge * edge + 1),
            plane_users: Plan::buffer("users of texels", plane_users),
            columns: Plan::buffer("columns of anchors", placed),
        })
    }

    /// Bytes on the device at most, with four texels of each plane a sample.
    pub(super) fn max_bytes(config: &ContextConfig, anchors: usize) -> u64 {
        let placed = if config.kind.sampled() > 0 { anchors } else { 0 };
        Self::plan(config, anchors, 12 * placed).bytes()
    }

    /// Uploads tables that [`ContextAnchors::check`] accepts.
    pub(super) fn upload(
        device: &Device,
        config: &ContextConfig,
        anchors: &ContextAnchors,
    ) -> Result<Self, GpuError> {
        let edge = if config.kind.sampled() > 0 { config.planes.edge } else { 0 };
        let (user_starts, users) = anchors.users();
        let (plane_starts, plane_users) = anchors.plane_users(edge);
        let made = Self::plan(config, anchors.count, plane_users.len()).make(device)?;
        device.write(&made.priors, &anchors.priors);
        device.write(&made.texels, &anchors.texels);
        device.write(&made.neighbors, &anchors.neighbors);
        device.write(&made.user_starts, &user_starts);
        device.write(&made.users, &users);
        device.write(&made.plane_starts, &plane_starts);
        device.write(&made.plane_users, &plane_users);
        Ok(made)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{codec::context::robust_frame, domain::ContextKind, train::context::PlaneConfig};

    fn config(kind: ContextKind) -> ContextConfig {
        let planes = PlaneConfig { edge: 16, channels: 4, layers: 1, hidden: 0, latents: 2 };
        ContextConfig { kind, channels: [2, 6, 3], hidden: [2; 3], planes }
    }

    fn cells() -> Vec<[i32; 3]> {
        (0..60).map(|i| [i * 7 % 23, i * i % 31, i / 4 - 9]).collect()
    }

    #[test]
    fn users_are_the_neighbors_the_other_way_round() {
        let cells = cells();
        let anchors = ContextAnchors::new(&config(ContextKind::TriPlaneKnn), &robust_frame(&cells), &cells);
        anchors.check(&config(ContextKind::TriPlaneKnn)).expect("tables that fit");
        let (starts, users) = anchors.users();
        assert_eq!(users.len(), 4 * cells.len());
        for anchor in 0..cells.len() {
            let list = &users[starts[anchor] as usize..starts[anchor + 1] as usize];
            assert!(list.windows(2).all(|pair| pair[0] < pair[1]));
            assert!(list.iter().all(|user| anchors.neighbors[*user as usize] as usize == anchor));
        }
    }

    #[test]
    fn the_weights_of_a_sample_add_up_to_one_and_lie_around_its_place() {
        let cells = cells();
        let config = config(ContextKind::TriPlane);
        let anchors = ContextAnchors::new(&config, &robust_frame(&cells), &cells);
        let (starts, users) = anchors.plane_users(16);
        let mut sums = vec![[0.0; 3]; 3 * cells.len()];
        for texel in 0..3 * 256 {
            for [anchor, weight] in &users[starts[texel] as usize..starts[texel + 1] as usize] {
                let weight = f32::from_bits(*weight);
                assert!(weight > 0.0);
                let sum = &mut sums[3 * *anchor as usize + texel / 256];
                sum[0] += weight;
                sum[1] += weight * (texel % 16) as f32;
                sum[2] += weight * (texel % 256 / 16) as f32;
            }
        }
        for (sum, texel) in sums.iter().zip(&anchors.texels) {
            let [x, y, fx, fy] = texel.to_le_bytes().map(f32::from);
            let expected = [1.0, x + fx / 256.0, y + fy / 256.0];
            assert!(sum.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5), "{sum:?} {expected:?}");
        }
    }

    #[test]
    fn a_model_without_planes_has_priors_alone() {
        let cells = cells();
        let config = config(ContextKind::Position);
        let anchors = ContextAnchors::new(&config, &robust_frame(&cells), &cells);
        anchors.check(&config).expect("tables that fit");
        assert_eq!(anchors.priors.len(), 18 * 60);
        assert!(anchors.texels.is_empty() && anchors.neighbors.is_empty());
        assert_eq!(anchors.users(), (vec![0], Vec::new()));
    }

    #[test]
    fn tables_that_lead_astray_are_refused() {
        let cells = cells();
        let config = config(ContextKind::TriPlaneKnn);
        let good = ContextAnchors::new(&config, &robust_frame(&cells), &cells);
        let mut far = good.clone();
        far.neighbors[7] = 60;
        let mut outside = good.clone();
        outside.texels[3] = 16;
        let mut short = good.clone();
        short.priors.pop();
        for bad in [far, outside, short, ContextAnchors { count: 59, ..good.clone() }] {
            assert!(bad.check(&config).is_err());
        }
        assert_eq!(good.check(&config), Ok(()));
        assert_eq!(ContextAnchors::new(&config, &robust_frame(&[]), &[]).check(&config), Ok(()));
    }
}
