//! What a run chose for its dataset and machine, and why: part of a file's provenance.
//!
//! Invariant: nothing here depends on time, so the same run states the same choices.

use serde::{Deserialize, Serialize};

use super::{ExposureChoice, ExposureTrial, Voxel};

/// What bounds the size that growth may reach.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SizeBound {
    /// The preset.
    Preset,
    /// The adapter's buffers or the memory budget.
    Memory,
}

/// What a run chose for its dataset and machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Choices {
    /// Anchors that growth may reach.
    pub max_anchors: usize,
    /// Why not more.
    pub max_anchors_by: SizeBound,
    /// Points of the dataset's cloud, or random ones.
    pub points: usize,
    /// Whether the points are random, since the dataset has none.
    pub random_points: bool,
    /// The widths before channel pruning; none where nothing was pruned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub narrowed_from: Option<Widths>,
    /// The trial after which color corrections were learnt; none where they were not, or where the option decided.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure: Option<ExposureTrial>,
}

/// The widths of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Widths {
    /// Feature channels.
    pub features: usize,
    /// Offset slots per anchor.
    pub offsets: usize,
}

/// A choice for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Explanation {
    /// What was chosen.
    pub what: String,
    /// What was chosen for it.
    pub value: String,
    /// Why.
    pub because: String,
}

impl Explanation {
    /// An explanation of these words.
    #[must_use]
    pub fn new(what: &str, value: impl Into<String>, because: impl Into<String>) -> Self {
        Self { what: what.to_owned(), value: value.into(), because: because.into() }
    }
}

impl Choices {
    /// The choices for people; `voxel` is the rule of the run and `edge` the edge that it gave, in world units.
    #[must_use]
    pub fn explain(&self, voxel: Voxel, edge: f32) -> Vec<Explanation> {
        let points =
            format!("{} {}", self.points, if self.random_points { "random points" } else { "points" });
        let because = match voxel {
            Voxel::Auto => format!("by the median spacing of {points}"),
            Voxel::Published => format!("the published rule, over {points}"),
            Voxel::Edge(asked) if f64::from(edge) > 1.001 * asked => {
                format!("the least that reaches across {points}; the option's {asked} does not")
            }
            Voxel::Edge(_) => "the option".to_owned(),
        };
        let mut all = vec![
            Explanation::new("voxel", edge.to_string(), because),
            Explanation::new(
                "anchors at most",
                self.max_anchors.to_string(),
                match self.max_anchors_by {
                    SizeBound::Preset => "the preset's number fits the adapter and the memory",
                    SizeBound::Memory => "more do not fit the adapter or the memory",
                },
            ),
        ];
        all.extend(
            self.exposure.map(|trial| {
                Explanation::new("color corrections", "on", ExposureChoice::by(trial).because())
            }),
        );
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_choice_says_what_it_is_and_why() {
        let choices = Choices {
            max_anchors: 40_000,
            max_anchors_by: SizeBound::Preset,
            points: 5000,
            random_points: false,
            narrowed_from: Some(Widths { features: 32, offsets: 10 }),
            exposure: None,
        };
        let said = choices.explain(Voxel::Auto, 0.25);
        let said: Vec<String> = said
            .iter()
            .map(|choice| format!("{} {}: {}", choice.what, choice.value, choice.because))
            .collect();
        assert_eq!(
            said,
            [
                "voxel 0.25: by the median spacing of 5000 points",
                "anchors at most 40000: the preset's number fits the adapter and the memory",
            ]
        );
        let random = Choices { random_points: true, max_anchors_by: SizeBound::Memory, ..choices };
        let said = random.explain(Voxel::Published, 0.25);
        assert_eq!(said[0].because, "the published rule, over 5000 random points");
        assert!(said[1].because.contains("memory"));
        assert_eq!(random.explain(Voxel::Edge(0.1), 0.1)[0].because, "the option");
        let enlarged = &random.explain(Voxel::Edge(0.1), 0.25)[0];
        assert_eq!(enlarged.value, "0.25");
        assert!(enlarged.because.contains("the option's 0.1 does not"), "{}", enlarged.because);
        let corrected =
            Choices { exposure: Some(ExposureTrial { views: 4, gain: 1.5, needed: 0.5 }), ..random.clone() };
        let said = &corrected.explain(Voxel::Auto, 0.25)[2];
        assert_eq!((&*said.what, &*said.value), ("color corrections", "on"));
        assert!(said.because.contains("gain 1.50 dB"), "{}", said.because);
        let mut json = serde_json::to_value(&random).expect("JSON");
        // In files of earlier versions, which could shorten a run.
        json["shortened"] = serde_json::json!({ "converged_at": 900, "steps": 1267, "full_steps": 2000 });
        assert_eq!(serde_json::from_value::<Choices>(json).expect("choices"), random);
    }
}
