//! How the figures of a report were measured: sets whose views are held out by another rule are named with it.

use super::record::RunRecord;

/// Each distinct convention as a sentence; with the names of its sets where there are several.
pub fn by_set(records: &[RunRecord]) -> Vec<String> {
    let mut found: Vec<(String, Vec<&str>)> = Vec::new();
    for run in records {
        let text = run.metrics.conventions.to_string();
        match found.iter_mut().find(|(known, _)| *known == text) {
            Some((_, sets)) if sets.contains(&run.set.as_str()) => {}
            Some((_, sets)) => sets.push(&run.set),
            None => found.push((text, vec![&run.set])),
        }
    }
    if let [(text, _)] = found.as_slice() {
        return vec![text.clone()];
    }
    found.into_iter().map(|(text, sets)| format!("{}: {text}", sets.join(", "))).collect()
}

#[cfg(test)]
mod tests {
    use tcgs_codec::domain::{HoldOut, ModelKind};

    use super::*;
    use crate::report::summary::tests::record;

    #[test]
    fn sets_held_out_by_different_rules_are_named_with_them() {
        let run = record(ModelKind::Tcgs, None, 0, 30.0, 1000);
        let usual = run.metrics.conventions.to_string();
        let twice = [run.clone(), run.clone()];
        assert_eq!(by_set(&twice), std::slice::from_ref(&usual));
        let mut sector = RunRecord { set: "ball-sector".to_owned(), ..run.clone() };
        sector.metrics.conventions = sector.metrics.conventions.of(HoldOut::Sector);
        let other = sector.metrics.conventions.to_string();
        let expected = [format!("ball: {usual}"), format!("ball-sector: {other}")];
        assert_eq!(by_set(&[run.clone(), sector, run]), expected);
    }
}
