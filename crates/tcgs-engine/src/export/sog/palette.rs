//! A palette of view-dependent colors: Gaussians whose coefficients are alike share an entry.

use super::{codebook::Codebook, opacity};
use crate::domain::{GaussianScene, harmonics::functions};

/// Most entries: labels have 16 bits.
const MAX_ENTRIES: usize = 65536;

/// Gaussians to an entry, in the mean.
const SHARING: usize = 4;

/// Least weight of a Gaussian among those of mean weight one, so that none is of no account.
const LEAST_WEIGHT: f64 = 1e-3;

/// Entries with the label of each Gaussian.
pub(super) struct Palette {
    /// By pixel.
    pub(super) labels: Vec<u16>,
    pub(super) codebook: Codebook,
    /// Codes, `[entries][coefficients][3]`.
    pub(super) codes: Vec<u8>,
    /// Coefficients of a channel in an entry.
    pub(super) coefficients: usize,
}

impl Palette {
    /// Splits the Gaussians in two along the coefficient that varies most, the group of the largest squared error first. Errors count by
    /// how much of a picture shows them: opacity times area.
    pub(super) fn of(scene: &GaussianScene, order: &[usize]) -> Self {
        let coefficients = functions(scene.degree) - 1;
        let width = 3 * coefficients;
        let rows: Vec<&[f32]> =
            order.iter().map(|index| scene.sh[*index][1..=coefficients].as_flattened()).collect();
        let weights = weights(scene, order);
        let entries = order.len().div_ceil(SHARING).min(MAX_ENTRIES);
        let mut groups = std::collections::BinaryHeap::new();
        groups.push(Group::of(&rows, &weights, (0..rows.len()).collect()));
        while groups.len() < entries {
            let Some(group) = groups.pop() else { break };
            if group.members.len() < 2 || group.error <= 0.0 {
                groups.push(group);
                break;
            }
            let (axis, middle) = (group.axis, group.mean[group.axis]);
            let (below, above): (Vec<usize>, Vec<usize>) =
                group.members.iter().partition(|member| f64::from(rows[**member][axis]) < middle);
            if below.is_empty() || above.is_empty() {
                // Values that differ by less than a float's step.
                groups.push(Group { error: 0.0, ..group });
                continue;
            }
            groups.push(Group::of(&rows, &weights, below));
            groups.push(Group::of(&rows, &weights, above));
        }
        let mut groups = groups.into_vec();
        // Like entries get like labels, which pack better.
        groups.sort_unstable_by_key(|group| group.members[0]);
        let codebook =
            Codebook::of(groups.iter().flat_map(|group| group.mean.iter().map(|value| *value as f32)));
        let mut labels = vec![0; rows.len()];
        let mut codes = Vec::with_capacity(width * groups.len());
        for (label, group) in groups.iter().enumerate() {
            group.members.iter().for_each(|member| labels[*member] = label as u16);
            codes.extend(group.mean.iter().map(|value| codebook.nearest(*value as f32)));
        }
        Self { labels, codebook, codes, coefficients }
    }

    pub(super) fn len(&self) -> usize {
        self.codes.len() / (3 * self.coefficients)
    }

    /// The codes of an entry's coefficients.
    pub(super) fn entry(&self, label: usize) -> impl Iterator<Item = [u8; 3]> {
        let width = 3 * self.coefficients;
        self.codes[label * width..][..width].as_chunks().0.iter().copied()
    }

    /// An entry's coefficients as they are read.
    pub(super) fn read(&self, label: u16) -> Vec<[f32; 3]> {
        self.entry(usize::from(label)).map(|rgb| rgb.map(|code| self.codebook.value(code))).collect()
    }
}

/// Gaussians of one entry.
struct Group {
    members: Vec<usize>,
    mean: Vec<f64>,
    /// Sum of squares from the mean.
    error: f64,
    /// The coefficient that varies most.
    axis: usize,
}

impl Group {
    fn of(rows: &[&[f32]], weights: &[f64], members: Vec<usize>) -> Self {
        let width = members.first().map_or(0, |member| rows[*member].len());
        let (mut total, mut sums, mut squares) = (0.0, vec![0.0; width], vec![0.0; width]);
        for member in &members {
            let weight = weights[*member];
            total += weight;
            for ((sum, square), value) in sums.iter_mut().zip(&mut squares).zip(rows[*member]) {
                *sum += weight * f64::from(*value);
                *square += weight * f64::from(*value).powi(2);
            }
        }
        let spread: Vec<f64> =
            sums.iter().zip(&squares).map(|(sum, square)| (square - sum * sum / total).max(0.0)).collect();
        let axis = (1..width).fold(0, |best, k| if spread[k] > spread[best] { k } else { best });
        let mean = sums.iter().map(|sum| sum / total).collect();
        Self { members, mean, error: spread.iter().sum(), axis }
    }
}

/// The weight of each Gaussian's error, one in the mean.
fn weights(scene: &GaussianScene, order: &[usize]) -> Vec<f64> {
    let shown = |index: &usize| {
        let mut logs = scene.log_scales[*index].map(f64::from);
        logs.sort_unstable_by(f64::total_cmp);
        (opacity(scene.opacity_logits[*index]) * (logs[1] + logs[2]).exp())
            .clamp(f64::MIN_POSITIVE, f64::MAX / 1e9)
    };
    let shown: Vec<f64> = order.iter().map(shown).collect();
    let mean = shown.iter().sum::<f64>() / shown.len().max(1) as f64;
    shown.into_iter().map(|shown| (shown / mean).max(LEAST_WEIGHT)).collect()
}

impl Ord for Group {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        // Members differ between groups, so the order is the same in every run.
        self.error.total_cmp(&other.error).then_with(|| other.members[0].cmp(&self.members[0]))
    }
}

impl PartialOrd for Group {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Group {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Group {}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::gaussians::SH_COEFFICIENTS;

    #[test]
    fn what_is_large_and_opaque_keeps_its_color() {
        // Of eight Gaussians, which share two entries, the last one is seen most.
        let mut scene = GaussianScene {
            means: vec![[0.0; 3]; 8],
            log_scales: vec![[-4.0; 3]; 8],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 8],
            opacity_logits: vec![0.0; 8],
            sh: vec![[[0.0; 3]; SH_COEFFICIENTS]; 8],
            degree: 1,
            ..GaussianScene::default()
        };
        for (index, row) in scene.sh.iter_mut().enumerate() {
            row[1] = [index as f32 / 8.0 - (index % 2) as f32; 3];
        }
        scene.sh[7][1] = [0.1; 3];
        let order: Vec<usize> = (0..8).collect();
        let error = |scene: &GaussianScene| {
            let palette = Palette::of(scene, &order);
            assert_eq!(palette.len(), 2);
            (palette.read(palette.labels[7])[0][0] - 0.1).abs()
        };
        let alike = error(&scene);
        scene.log_scales[7] = [-1.0, -1.0, -4.0];
        let larger = error(&scene);
        assert!(larger < 0.1 * alike, "{alike} as one of eight, {larger} as the one that is seen");
    }
}
