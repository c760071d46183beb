//! Published figures of other methods, shown beside ours only where the dataset is theirs.

use std::{collections::BTreeMap, sync::LazyLock};

use tcgs_codec::domain::Background;

use super::{record::RunRecord, summary::Group};

/// The committed table; its head has the sources.
const TABLE: &str = include_str!("published.csv");

/// A published row. A source that does not print a figure leaves its cell empty.
#[derive(Debug, Clone, PartialEq)]
pub struct Published {
    pub dataset: String,
    /// Empty for the mean over the dataset.
    pub scene: String,
    pub method: String,
    pub psnr: f64,
    pub ssim: Option<f64>,
    pub lpips: Option<f64>,
    pub bytes: u64,
    pub source: String,
}

/// A dataset of the field as papers use it.
struct Protocol {
    name: &'static str,
    scenes: &'static [&'static str],
    /// Width, height and number of the test views, where the dataset has them fixed.
    views: Option<([u32; 2], usize)>,
    /// The background that photographs with alpha are composited on, where the dataset has alpha.
    background: Option<Background>,
}

const PROTOCOLS: [Protocol; 4] = [
    Protocol {
        name: "synthetic-nerf",
        scenes: &["chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"],
        views: Some(([800, 800], 200)),
        background: Some(Background::White),
    },
    Protocol { name: "tanks-and-temples", scenes: &["train", "truck"], views: None, background: None },
    Protocol { name: "deep-blending", scenes: &["drjohnson", "playroom"], views: None, background: None },
    Protocol {
        name: "mip-nerf-360",
        scenes: &[
            "bicycle", "bonsai", "counter", "flowers", "garden", "kitchen", "room", "stump", "treehill",
        ],
        views: None,
        background: None,
    },
];

static ROWS: LazyLock<Vec<Published>> = LazyLock::new(|| parse(TABLE).unwrap_or_default());

fn parse(text: &str) -> Option<Vec<Published>> {
    let lines = text.lines().filter(|line| !line.starts_with('#')).skip(1);
    lines
        .map(|line| {
            let cells: [&str; 8] = line.split(',').collect::<Vec<_>>().try_into().ok()?;
            let [dataset, scene, method, psnr, ssim, lpips, bytes, source] = cells;
            Some(Published {
                dataset: dataset.to_owned(),
                scene: scene.to_owned(),
                method: method.to_owned(),
                psnr: psnr.parse().ok()?,
                ssim: optional(ssim)?,
                lpips: optional(lpips)?,
                bytes: bytes.parse().ok()?,
                source: source.to_owned(),
            })
        })
        .collect()
}

/// A cell that may be empty; `None` where it is not a number.
fn optional(cell: &str) -> Option<Option<f64>> {
    if cell.is_empty() { Some(None) } else { cell.parse().ok().map(Some) }
}

/// Published rows that are shown for a set, or for the mean over a dataset.
#[derive(Debug)]
pub struct Comparison {
    /// `synthetic-nerf/chair`, or a dataset.
    pub subject: String,
    /// Sets that our side is made of.
    pub sets: Vec<String>,
    pub rows: Vec<&'static Published>,
    /// What differs from the protocol of the published figures, if anything.
    pub caution: Option<String>,
}

/// Checks the scenes that a matrix names, as `DATASET/SCENE` by set.
pub fn check(scenes: &BTreeMap<String, String>) -> Result<(), String> {
    for (set, scene) in scenes {
        if find(scene).is_none() {
            let known: Vec<&str> = PROTOCOLS.iter().map(|protocol| protocol.name).collect();
            return Err(format!(
                "published.{set}: '{scene}' is no scene of a dataset with published figures: give DATASET/SCENE with one of {}",
                known.join(", ")
            ));
        }
    }
    Ok(())
}

fn find(scene: &str) -> Option<(&'static Protocol, &str)> {
    let (dataset, scene) = scene.split_once('/')?;
    let protocol = PROTOCOLS.iter().find(|protocol| protocol.name == dataset)?;
    protocol.scenes.contains(&scene).then_some((protocol, scene))
}

/// What may be shown beside these groups: rows of each scene that is declared and has the dataset's own size of views, and means of
/// a dataset whose scenes are all there.
pub fn comparisons(scenes: &BTreeMap<String, String>, groups: &[Group<'_>]) -> Vec<Comparison> {
    let mut found = Vec::new();
    let mut of_datasets: BTreeMap<&str, BTreeMap<&str, (String, Option<String>)>> = BTreeMap::new();
    for (set, scene) in scenes {
        let Some((protocol, scene)) = find(scene) else { continue };
        let Some(group) = groups.iter().find(|group| group.set() == set) else { continue };
        let Ok(caution) = caution(protocol, group.first()) else { continue };
        let rows = rows(protocol.name, scene);
        if !rows.is_empty() {
            let subject = format!("{}/{scene}", protocol.name);
            found.push(Comparison { subject, sets: vec![set.clone()], rows, caution: caution.clone() });
        }
        of_datasets.entry(protocol.name).or_default().insert(scene, (set.clone(), caution));
    }
    for (name, sets) in of_datasets {
        let is_whole = PROTOCOLS.iter().any(|protocol| {
            protocol.name == name && protocol.scenes.iter().all(|scene| sets.contains_key(scene))
        });
        if is_whole {
            let caution = sets.values().find_map(|(_, caution)| caution.clone());
            let sets = sets.into_values().map(|(set, _)| set).collect();
            found.push(Comparison { subject: name.to_owned(), sets, rows: rows(name, ""), caution });
        }
    }
    found
}

fn rows(dataset: &str, scene: &str) -> Vec<&'static Published> {
    let mut rows: Vec<&Published> =
        ROWS.iter().filter(|row| row.dataset == dataset && row.scene == scene).collect();
    rows.sort_by_key(|row| row.bytes);
    rows
}

/// What differs from the protocol, which is nothing for `None`; an error where the set is another one.
fn caution(protocol: &Protocol, run: &RunRecord) -> Result<Option<String>, ()> {
    let mut differences = Vec::new();
    if let Some((size, views)) = protocol.views {
        if run.view_size != Some(size) {
            return Err(());
        }
        let ours = run.metrics.test.views;
        if ours != views {
            differences.push(format!("ours are over {ours} of the {views} test views"));
        }
    }
    let ours = run.options.background;
    if let Some(theirs) = protocol.background.filter(|theirs| *theirs != ours) {
        differences.push(format!("ours are on {}, the dataset's protocol is {}", ours.name(), theirs.name()));
    }
    Ok((!differences.is_empty()).then(|| differences.join("; ")))
}

#[cfg(test)]
mod tests {
    use tcgs_codec::domain::ModelKind;

    use super::*;
    use crate::report::summary::tests::record;

    #[test]
    fn the_committed_table_has_the_papers_ten_methods_on_its_three_datasets() {
        let rows = parse(TABLE).expect("a table");
        let methods = [
            "3DGS",
            "Scaffold-GS",
            "Lee",
            "Compressed3D",
            "EAGLES",
            "LightGaussian",
            "Morgenstern",
            "Navaneet",
            "HAC",
            "TC-GS",
        ];
        for dataset in ["synthetic-nerf", "tanks-and-temples", "deep-blending"] {
            for method in methods {
                let is_it = |row: &&Published| {
                    row.dataset == dataset && row.method == method && row.source == "tc-gs table 1"
                };
                assert_eq!(rows.iter().filter(is_it).count(), 1, "{dataset} {method}");
            }
        }
        for method in ["HAC++ low rate", "HAC++ high rate", "HEMGS low rate", "HEMGS high rate"] {
            assert!(rows.iter().any(|row| row.scene == "chair" && row.method == method), "{method}");
        }
        assert!(rows.iter().any(|row| row.method == "Smol-GS base" && row.dataset == "mip-nerf-360"));
        // 1.33 MiB, table 1.
        let paper = rows.iter().find(|row| row.method == "TC-GS").expect("a row");
        assert_eq!((paper.psnr, paper.bytes), (31.28, 1_394_606));
        for row in &rows {
            let is_known = |protocol: &Protocol| {
                protocol.name == row.dataset
                    && (row.scene.is_empty() || protocol.scenes.contains(&row.scene.as_str()))
            };
            assert!(PROTOCOLS.iter().any(is_known), "{row:?}");
        }
    }

    #[test]
    fn a_curve_of_pruned_splats_has_no_ssim() {
        let rows = rows("synthetic-nerf", "chair");
        let kiss: Vec<_> = rows.iter().filter(|row| row.method.starts_with("KISS-GS")).collect();
        assert_eq!(kiss.len(), 6);
        assert!(kiss.iter().all(|row| row.ssim.is_none() && row.lpips.is_none()));
        assert!(kiss.windows(2).all(|pair| pair[0].psnr < pair[1].psnr && pair[0].bytes < pair[1].bytes));
        let again = rows.iter().find(|row| row.method == "HAC++ low rate (run again)").expect("a row");
        assert_eq!((again.psnr, again.bytes), (33.29, 654_000));
    }

    #[test]
    fn figures_of_a_dataset_are_left_out_beside_another_one() {
        let scenes = BTreeMap::from([("ball".to_owned(), "synthetic-nerf/chair".to_owned())]);
        let mut run = record(ModelKind::Tcgs, None, 0, 30.0, 1000);
        assert!(comparisons(&scenes, &Group::all(&[run.clone()])).is_empty(), "16x16 is not theirs");
        run.view_size = Some([800, 800]);
        let own = [run.clone()];
        let groups = Group::all(&own);
        let found = comparisons(&scenes, &groups);
        assert_eq!(found.len(), 1, "no mean over eight scenes from one");
        assert!(found[0].rows.iter().all(|row| row.scene == "chair"));
        let caution =
            "ours are over 2 of the 200 test views; ours are on black, the dataset's protocol is white";
        assert_eq!(found[0].caution.as_deref(), Some(caution));
        assert!(comparisons(&BTreeMap::new(), &groups).is_empty(), "nothing is claimed unasked");
        let wrong = BTreeMap::from([("ball".to_owned(), "synthetic-nerf/teapot".to_owned())]);
        assert!(check(&wrong).expect_err("refused").contains("published.ball"));
        assert_eq!(check(&scenes), Ok(()));
    }
}
