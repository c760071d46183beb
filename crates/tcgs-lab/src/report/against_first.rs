//! Groups of runs against the first group of their set and schedule, by pairs of equal seed.

use tcgs_engine::eval::Estimate;

use super::{
    cells::{shown, signed},
    record::RunRecord,
    section::{Block, Table, texts},
    summary::Group,
};

/// What the columns of the table are means over.
const NOTE: &str = "Pairs of runs of equal seed, set and steps. * marks differences whose interval excludes zero. Ratios of times are \
    taken only between runs of one session of this command, which makes models of one seed one after another. Where \
    that leaves another number of pairs than the row's, it follows in parentheses.";

/// Every group against the first of its set and schedule.
pub fn against_first(groups: &[Group<'_>]) -> Vec<Block<'static>> {
    let head = texts(&[
        "set",
        "model",
        "against",
        "steps",
        "pairs",
        "ΔPSNR dB",
        "ΔSSIM",
        "bytes, ratio",
        "training s, ratio",
        "decoding s, ratio",
    ]);
    vec![Block::Table(Table::new(head, rows(groups))), Block::Note(NOTE.to_owned())]
}

fn rows(groups: &[Group<'_>]) -> Vec<Vec<String>> {
    let mut rows = Vec::new();
    for (place, group) in groups.iter().enumerate() {
        let is_first = |other: &&Group<'_>| other.is_comparable(group) && other.has_schedule_of(group);
        let Some(first) = groups[..place].iter().find(is_first) else { continue };
        let psnr = group.difference(first, |run| run.metrics.test.psnr);
        let pairs = psnr.map_or(0, |psnr| psnr.runs);
        let time = |time: fn(&RunRecord) -> f64| of_pairs(group.time_ratio(first, time), 2, pairs);
        rows.push(vec![
            group.set().to_owned(),
            group.name(),
            first.name(),
            group.steps(),
            pairs.to_string(),
            signed(psnr, 2),
            signed(group.difference(first, |run| run.metrics.test.ssim), 4),
            shown(group.ratio(first, |run| run.metrics.bytes.total as f64), 4),
            time(|run| run.metrics.seconds.train),
            time(RunRecord::least_decode_seconds),
        ]);
    }
    rows
}

/// A ratio, with the number of its pairs where that is not the row's.
pub(super) fn of_pairs(ratio: Option<Estimate>, decimals: usize, pairs: usize) -> String {
    let text = shown(ratio, decimals);
    match ratio {
        Some(ratio) if ratio.runs != pairs => format!("{text} ({})", ratio.runs),
        _ => text,
    }
}

#[cfg(test)]
mod tests {
    use tcgs_codec::domain::ModelKind;

    use super::*;
    use crate::report::summary::tests::record;

    #[test]
    fn ratios_of_fewer_pairs_than_the_row_state_their_number() {
        let records: Vec<RunRecord> = (0..3)
            .flat_map(|seed| {
                [ModelKind::Scaffold, ModelKind::Tcgs].map(|model| record(model, None, seed, 30.0, 100))
            })
            .collect();
        let times = |records: &[RunRecord]| {
            let rows = rows(&Group::all(records));
            assert_eq!((rows.len(), rows[0][4].as_str()), (1, "3"));
            [rows[0][8].clone(), rows[0][9].clone()]
        };
        assert_eq!(times(&records), ["1.00 ± 0.00", "1.00 ± 0.00"]);
        let mut other = records.clone();
        other[1].session = "later".to_owned();
        assert_eq!(times(&other), ["1.00 ± 0.00 (2)", "1.00 ± 0.00 (2)"]);
        other.iter_mut().skip(1).step_by(2).for_each(|run| run.session = "later".to_owned());
        assert_eq!(times(&other), ["–", "–"]);
    }
}
