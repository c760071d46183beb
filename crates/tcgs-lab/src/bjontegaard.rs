//! Bjøntegaard's mean differences between two rate-distortion curves: rate in per cent at equal PSNR, and PSNR in dB at equal rate.
//!
//! Rates are taken as logarithms. `Cubic` is the original fit (G. Bjøntegaard, "Calculation of average PSNR differences between
//! RD-curves", ITU-T VCEG-M33, 2001): a polynomial of degree 3 by least squares, through the points if there are four. `Pchip` goes
//! through all points by cubics with Fritsch and Carlson's monotone slopes, as the common test conditions of JCT-VC and JVET do; it
//! needs two points, and no fit can swing between them. Both integrate over the range that the curves share.

/// How a curve goes between its points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CurveFit {
    /// One polynomial of degree 3; needs four points.
    Cubic,
    /// Piecewise monotone cubics; needs two points.
    Pchip,
}

/// A point of a curve: bytes or any other rate, and dB.
pub type RatePoint = (f64, f64);

/// The mean difference of `test` from `anchor` in rate at equal PSNR, in per cent: negative if `test` is smaller.
///
/// `None` with too few points for the fit, two points of one PSNR, rates that are not positive, or curves that share no PSNR.
#[must_use]
pub fn rate_difference(anchor: &[RatePoint], test: &[RatePoint], fit: CurveFit) -> Option<f64> {
    let curve = |points: &[RatePoint]| -> Vec<(f64, f64)> {
        points.iter().map(|(rate, psnr)| (*psnr, rate.log10())).collect()
    };
    mean_difference(&curve(anchor), &curve(test), fit).map(|mean| 100.0 * (10.0_f64.powf(mean) - 1.0))
}

/// The mean difference of `test` from `anchor` in PSNR at equal rate, in dB: positive if `test` is better. `None` as for
/// [`rate_difference`], with rates in place of PSNR.
#[must_use]
pub fn psnr_difference(anchor: &[RatePoint], test: &[RatePoint], fit: CurveFit) -> Option<f64> {
    let curve = |points: &[RatePoint]| -> Vec<(f64, f64)> {
        points.iter().map(|(rate, psnr)| (rate.log10(), *psnr)).collect()
    };
    mean_difference(&curve(anchor), &curve(test), fit)
}

/// The integral of `test` less that of `anchor` over the arguments that both have, by that range's length.
fn mean_difference(anchor: &[(f64, f64)], test: &[(f64, f64)], fit: CurveFit) -> Option<f64> {
    let (anchor, test) = (sorted(anchor)?, sorted(test)?);
    let low = anchor.first()?.0.max(test.first()?.0);
    let high = anchor.last()?.0.min(test.last()?.0);
    if low >= high {
        return None;
    }
    let integral = |points: &[(f64, f64)]| match fit {
        CurveFit::Cubic => cubic_integral(points, low, high),
        CurveFit::Pchip => pchip_integral(points, low, high),
    };
    Some((integral(&test)? - integral(&anchor)?) / (high - low))
}

/// The points in the order of their arguments; `None` if two share one or a number is not finite.
fn sorted(points: &[(f64, f64)]) -> Option<Vec<(f64, f64)>> {
    let mut points = points.to_vec();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let is_finite = points.iter().all(|(x, y)| x.is_finite() && y.is_finite());
    (is_finite && points.windows(2).all(|pair| pair[0].0 < pair[1].0)).then_some(points)
}

/// The integral of the polynomial of degree 3 that fits the points best.
fn cubic_integral(points: &[(f64, f64)], low: f64, high: f64) -> Option<f64> {
    if points.len() < 4 {
        return None;
    }
    // About the middle and in units of half the range, or the normal equations lose digits.
    let middle = 0.5 * (points[0].0 + points[points.len() - 1].0);
    let unit = 0.5 * (points[points.len() - 1].0 - points[0].0);
    let mut normal = [[0.0; 5]; 4];
    for (x, y) in points {
        let x = (x - middle) / unit;
        let powers = [1.0, x, x * x, x * x * x];
        for (row, power) in normal.iter_mut().zip(powers) {
            for (cell, other) in row.iter_mut().zip(powers) {
                *cell += power * other;
            }
            row[4] += power * y;
        }
    }
    let coefficients = solve(normal)?;
    let primitive = |x: f64| {
        let x = (x - middle) / unit;
        (1..=4).zip(coefficients).map(|(power, c)| c * x.powi(power) / f64::from(power)).sum::<f64>() * unit
    };
    Some(primitive(high) - primitive(low))
}

/// Solves four equations by elimination with the largest pivots.
fn solve(mut rows: [[f64; 5]; 4]) -> Option<[f64; 4]> {
    for column in 0..4 {
        let pivot = (column..4).max_by(|a, b| rows[*a][column].abs().total_cmp(&rows[*b][column].abs()))?;
        rows.swap(column, pivot);
        if rows[column][column].abs() < 1e-12 {
            return None;
        }
        let pivot = rows[column];
        for (index, row) in rows.iter_mut().enumerate() {
            if index != column {
                let factor = row[column] / pivot[column];
                row.iter_mut().zip(pivot).for_each(|(cell, above)| *cell -= factor * above);
            }
        }
    }
    Some([0, 1, 2, 3].map(|index| rows[index][4] / rows[index][index]))
}

/// The integral of the piecewise cubic through the points with monotone slopes.
fn pchip_integral(points: &[(f64, f64)], low: f64, high: f64) -> Option<f64> {
    if points.len() < 2 {
        return None;
    }
    let slopes = pchip_slopes(points);
    let mut sum = 0.0;
    for (pair, slope) in points.windows(2).zip(slopes.windows(2)) {
        let ([(x0, y0), (x1, y1)], [d0, d1]) = ([pair[0], pair[1]], [slope[0], slope[1]]);
        let (from, to) = (low.max(x0), high.min(x1));
        if from >= to {
            continue;
        }
        let h = x1 - x0;
        let secant = (y1 - y0) / h;
        let (c2, c3) = ((3.0 * secant - 2.0 * d0 - d1) / h, (d0 + d1 - 2.0 * secant) / (h * h));
        let primitive = |x: f64| {
            let s = x - x0;
            s * (y0 + s * (d0 / 2.0 + s * (c2 / 3.0 + s * c3 / 4.0)))
        };
        sum += primitive(to) - primitive(from);
    }
    Some(sum)
}

/// Slopes at the points: weighted harmonic means of the secants beside each, zero at extrema; three-point formulas at the ends (Fritsch
/// and Butland, SIAM J. Sci. Stat. Comput. 5, 1984).
fn pchip_slopes(points: &[(f64, f64)]) -> Vec<f64> {
    let widths: Vec<f64> = points.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
    let secants: Vec<f64> =
        points.windows(2).zip(&widths).map(|(pair, width)| (pair[1].1 - pair[0].1) / width).collect();
    if secants.len() == 1 {
        return vec![secants[0]; 2];
    }
    let last = secants.len() - 1;
    let mut slopes = vec![end_slope([widths[0], widths[1]], [secants[0], secants[1]])];
    for (width, secant) in widths.windows(2).zip(secants.windows(2)) {
        let [w1, w2] = [2.0 * width[1] + width[0], width[1] + 2.0 * width[0]];
        let is_monotone = secant[0] * secant[1] > 0.0;
        slopes.push(if is_monotone { (w1 + w2) / (w1 / secant[0] + w2 / secant[1]) } else { 0.0 });
    }
    slopes.push(end_slope([widths[last], widths[last - 1]], [secants[last], secants[last - 1]]));
    slopes
}

/// The slope at an end from the two intervals next to it, the outer one first.
fn end_slope([h0, h1]: [f64; 2], [d0, d1]: [f64; 2]) -> f64 {
    let slope = ((2.0 * h0 + h1) * d0 - h0 * d1) / (h0 + h1);
    if slope * d0 <= 0.0 {
        0.0
    } else if d0 * d1 <= 0.0 && slope.abs() > 3.0 * d0.abs() {
        3.0 * d0
    } else {
        slope
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(rates: [f64; 4], psnrs: [f64; 4]) -> Vec<RatePoint> {
        rates.into_iter().zip(psnrs).collect()
    }

    /// The example in the readme of the Python package `bjontegaard` (FAU-LMS, BSD-3).
    fn readme() -> [Vec<RatePoint>; 2] {
        [
            curve([9487.76, 4593.60, 2486.44, 1358.24], [40.037, 38.615, 36.845, 34.851]),
            curve([9787.80, 4469.00, 2451.52, 1356.24], [40.121, 38.651, 36.970, 34.987]),
        ]
    }

    /// The example that comes with the widespread script `bjontegaard_metric.py`.
    fn script() -> [Vec<RatePoint>; 2] {
        [
            curve([686.76, 309.58, 157.11, 85.95], [40.28, 37.18, 34.24, 31.42]),
            curve([893.34, 407.8, 204.93, 112.75], [40.39, 37.21, 34.17, 31.24]),
        ]
    }

    /// Figures that version 1.3.0 of the package `bjontegaard` gives for both examples. Its authors state that their PCHIP agrees
    /// with JVET's common-test-conditions spreadsheet (JVET-T2010) to ten decimals.
    #[test]
    fn differences_are_those_of_the_published_package() {
        for ([anchor, test], fit, rate, psnr) in [
            (readme(), CurveFit::Cubic, -4.420_462_706_026_296, 0.120_409_419_114_713),
            (readme(), CurveFit::Pchip, -4.417_485_350_589_045, 0.119_692_785_424_795),
            (script(), CurveFit::Cubic, 31.397_374_054_908_656, -1.184_897_921_770_328),
            (script(), CurveFit::Pchip, 31.379_878_202_397_627, -1.183_472_404_622_459),
        ] {
            let found = rate_difference(&anchor, &test, fit).expect("a difference");
            assert!((found - rate).abs() < 1e-7, "{fit:?}: {found} % and {rate} %");
            let found = psnr_difference(&anchor, &test, fit).expect("a difference");
            assert!((found - psnr).abs() < 1e-9, "{fit:?}: {found} dB and {psnr} dB");
        }
    }

    #[test]
    fn half_the_bytes_at_every_quality_are_minus_fifty_per_cent() {
        let anchor = [(1e6, 34.0), (2e5, 30.0), (5e5, 32.5), (1e5, 28.0)];
        let half = anchor.map(|(rate, psnr)| (rate / 2.0, psnr));
        let better = anchor.map(|(rate, psnr)| (rate, psnr + 0.5));
        for fit in [CurveFit::Cubic, CurveFit::Pchip] {
            let rate = rate_difference(&anchor, &half, fit).expect("a difference");
            assert!((rate + 50.0).abs() < 1e-9, "{fit:?}: {rate}");
            let psnr = psnr_difference(&anchor, &better, fit).expect("a difference");
            assert!((psnr - 0.5).abs() < 1e-9, "{fit:?}: {psnr}");
            assert_eq!(psnr_difference(&anchor, &anchor, fit), Some(0.0));
        }
    }

    #[test]
    fn what_cannot_be_compared_has_no_difference() {
        let two = [(1e5, 30.0), (2e5, 32.0)];
        assert_eq!(rate_difference(&two, &two, CurveFit::Cubic), None);
        assert_eq!(rate_difference(&two, &two, CurveFit::Pchip), Some(0.0));
        assert_eq!(rate_difference(&two, &[], CurveFit::Pchip), None);
        assert_eq!(
            rate_difference(&two, &[(1e5, 33.0), (2e5, 34.0)], CurveFit::Pchip),
            None,
            "nothing shared"
        );
        assert_eq!(
            rate_difference(&two, &[(1e5, 31.0), (2e5, 31.0)], CurveFit::Pchip),
            None,
            "one PSNR twice"
        );
        assert_eq!(psnr_difference(&two, &[(0.0, 31.0), (2e5, 32.0)], CurveFit::Pchip), None, "no bytes");
    }
}
