//! An entry of the comparison: a model, an ablation of the method, or the method with another `lambda`.

use std::{collections::BTreeSet, fmt, str::FromStr};

use tcgs::{
    domain::{Component, ModelKind, TrainOptions},
    train::Schedule,
};

/// Values of `lambda` for the method's curve, in addition to the preset's.
const LAMBDAS: [f64; 3] = [0.001, 0.002, 0.005];

/// The parts of the ablation: those of the published table in its order, then those of this program alone.
const PARTS: [Component; 7] = [
    Component::TriPlane,
    Component::Knn,
    Component::PlaneCompression,
    Component::Wavelet,
    Component::Masks,
    Component::Basis,
    Component::Regression,
];

/// One row of the table for each set.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Entry {
    /// What is trained.
    pub(crate) model: ModelKind,
    /// The part that is switched off.
    pub(crate) without: Option<Component>,
    /// The part that is switched on although it is off by default in short runs.
    pub(crate) with: Option<Component>,
    /// `lambda`, if not the preset's.
    pub(crate) lambda: Option<f64>,
}

impl Entry {
    fn whole(model: ModelKind) -> Self {
        Self { model, without: None, with: None, lambda: None }
    }

    /// The baselines, the method, its ablations and its curve.
    pub(crate) fn defaults() -> Vec<Self> {
        let models = [ModelKind::Gaussians3d, ModelKind::Scaffold, ModelKind::Tcgs].map(Self::whole);
        let tcgs = Self::whole(ModelKind::Tcgs);
        let ablations = PARTS.map(|part| Self { without: Some(part), ..tcgs.clone() });
        let curve = LAMBDAS.map(|lambda| Self { lambda: Some(lambda), ..tcgs.clone() });
        let more = PARTS.map(|part| Self { with: Some(part), ..tcgs.clone() });
        let possible = |entry: &Self| entry.options(&TrainOptions::default()).validated().is_ok();
        models.into_iter().chain(ablations).chain(more).chain(curve).filter(possible).collect()
    }

    /// Whether it takes part in the comparison at equal seconds; ablations and curves are compared at equal steps only.
    pub(crate) fn is_whole(&self) -> bool {
        self.without.is_none() && self.with.is_none() && self.lambda.is_none()
    }

    /// The plainer entry that trains the same model with these options: short runs have no compressed planes to leave out, long
    /// ones have them by default, and `lambda` may be the preset's own.
    pub(crate) fn duplicate_of(&self, shared: &TrainOptions) -> Option<Self> {
        let without = self.without.filter(|part| *part != Component::PlaneCompression);
        let plainer = Self { without, with: None, lambda: None, ..self.clone() };
        let same = Schedule::new(&self.options(shared)) == Schedule::new(&plainer.options(shared));
        (same && plainer != *self).then_some(plainer)
    }

    /// The options of its runs, from those that all runs share.
    pub(crate) fn options(&self, shared: &TrainOptions) -> TrainOptions {
        TrainOptions {
            model: self.model,
            without: self.without.into_iter().collect::<BTreeSet<_>>(),
            with: self.with.into_iter().collect::<BTreeSet<_>>(),
            lambda: self.lambda,
            ..shared.clone()
        }
    }
}

impl fmt::Display for Entry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut text = self.model.name().to_owned();
        if let Some(part) = self.without {
            text.push_str(&format!("-{part}"));
        }
        if let Some(part) = self.with {
            text.push_str(&format!("+{part}"));
        }
        if let Some(lambda) = self.lambda {
            text.push_str(&format!("@{lambda}"));
        }
        f.pad(&text)
    }
}

impl FromStr for Entry {
    type Err = String;

    /// `3dgs`, `scaffold` or `tcgs`, the last with `-PART`, `+PART` or `@LAMBDA` after it, in this order.
    fn from_str(text: &str) -> Result<Self, String> {
        let (name, lambda) = match text.split_once('@') {
            None => (text, None),
            Some((name, lambda)) => {
                let number = lambda.parse::<f64>().map_err(|_| format!("'{lambda}' is not a weight"))?;
                (name, Some(number))
            }
        };
        let part = |text: &str| text.parse::<Component>();
        let (name, with) = match name.split_once('+') {
            None => (name, None),
            Some((name, text)) => (name, Some(part(text)?)),
        };
        let (model, without) = match name.split_once('-') {
            None => (name, None),
            Some((model, text)) => (model, Some(part(text)?)),
        };
        let model: ModelKind = model.parse()?;
        if (without.is_some() || with.is_some()) && model != ModelKind::Tcgs {
            return Err(format!("'{text}': only tcgs has parts to leave out or to ask for"));
        }
        if lambda.is_some() && model != ModelKind::Tcgs {
            return Err(format!("'{text}': only tcgs weighs a rate"));
        }
        let entry = Self { model, without, with, lambda };
        entry.options(&TrainOptions::default()).validated().map_err(|fault| fault.fault)?;
        Ok(entry)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_are_read_as_they_are_written() {
        let whole = ["3dgs", "scaffold", "tcgs"];
        let parts = ["tcgs-wavelet", "tcgs+plane-compression", "tcgs-masks+plane-compression@0.001"];
        for text in whole.into_iter().chain(parts) {
            assert_eq!(text.parse::<Entry>().expect(text).to_string(), text);
        }
        let refused = [
            "",
            "nerf",
            "tcgs-",
            "tcgs-hope",
            "3dgs-wavelet",
            "tcgs+masks",
            "tcgs-plane-compression+plane-compression",
            "scaffold+plane-compression",
            "scaffold-wavelet",
            "3dgs@0.1",
            "tcgs@",
            "tcgs@x",
        ];
        for text in refused {
            assert!(text.parse::<Entry>().is_err(), "{text}");
        }
        let point = Entry { lambda: Some(0.0005), ..Entry::whole(ModelKind::Tcgs) };
        assert_eq!(point.to_string(), "tcgs@0.0005");
        assert!(!point.is_whole() && Entry::whole(ModelKind::Tcgs).is_whole());
    }

    #[test]
    fn what_this_version_can_do_competes_and_nothing_else() {
        let entries = Entry::defaults();
        let names: Vec<String> = entries.iter().map(Entry::to_string).collect();
        assert_eq!(names[..3], ["3dgs", "scaffold", "tcgs"]);
        assert!(names.contains(&"tcgs-masks".to_owned()), "{names:?}");
        assert!(names.iter().all(|name| name.parse::<Entry>().is_ok()), "{names:?}");
        let shared = TrainOptions::default();
        let swept = |lambda| TrainOptions { lambda: Some(lambda), ..shared.clone() }.validated().is_ok();
        let points = entries.iter().filter(|entry| entry.lambda.is_some()).count();
        assert_eq!(points, LAMBDAS.iter().filter(|lambda| swept(**lambda)).count());
    }

    #[test]
    fn what_trains_the_same_model_twice_is_a_duplicate() {
        let duplicates = |steps: u32, names: &[&str]| {
            let shared = TrainOptions { iterations: Some(steps), ..TrainOptions::default() };
            let duplicate = |name: &&str| {
                let entry: Entry = name.parse().expect("an entry");
                entry.duplicate_of(&shared).map(|plainer| plainer.to_string())
            };
            names.iter().map(duplicate).collect::<Vec<_>>()
        };
        let names = ["tcgs-plane-compression", "tcgs+plane-compression", "tcgs-wavelet", "tcgs"];
        let tcgs = || Some("tcgs".to_owned());
        assert_eq!(duplicates(300, &names), [tcgs(), None, None, None]);
        assert_eq!(duplicates(30_000, &names), [None, tcgs(), None, None]);
        let weighed = ["tcgs@0.0005", "tcgs@0.001", "tcgs-wavelet@0.0005"];
        assert_eq!(duplicates(300, &weighed), [tcgs(), None, Some("tcgs-wavelet".to_owned())]);
        let preview = TrainOptions { iterations: Some(300), ..TrainOptions::default() };
        let defaults = Entry::defaults();
        let doubled = defaults.iter().filter(|entry| entry.duplicate_of(&preview).is_some()).count();
        assert_eq!(doubled, 1, "all points of the curve are other than the method's own");
    }
}
