//! The held-out views that a run renders worst: those that look into reflections, or at what few photographs show.

use tcgs_codec::domain::Scores;

/// The mean PSNR of the worst tenth of the views, in dB: of `ceil(n / 10)` views. `None` without figures for each view.
pub fn worst_tenth(scores: &Scores) -> Option<f64> {
    let mut figures: Vec<f64> = scores.per_view.iter().map(|view| view.psnr).collect();
    figures.sort_by(f64::total_cmp);
    let worst = &figures[..figures.len().div_ceil(10)];
    (!worst.is_empty()).then(|| worst.iter().sum::<f64>() / worst.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scores(figures: &[f64]) -> Scores {
        let views: Vec<_> = figures
            .iter()
            .map(|psnr| serde_json::json!({ "name": "a view", "psnr": psnr, "ssim": 0.9, "lpips": null }))
            .collect();
        let views = serde_json::json!({ "psnr": 30.0, "ssim": 0.9, "lpips": null, "lpips_network": null, "views": figures.len(), "per_view": views });
        serde_json::from_value(views).expect("scores")
    }

    #[test]
    fn a_tenth_is_at_least_one_view() {
        assert_eq!(worst_tenth(&scores(&[])), None);
        assert_eq!(worst_tenth(&scores(&[31.0, 24.0, 30.0])), Some(24.0));
        let eleven: Vec<f64> = (20..31).rev().map(f64::from).collect();
        assert_eq!(worst_tenth(&scores(&eleven)), Some(20.5));
    }
}
