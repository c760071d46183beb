//! Held-out views beside their photographs, the worst first.

use maud::{Markup, html};

use super::units::figure;
use crate::domain::{HeldOut, HeldOutView, Scores, ViewScore};

/// The section of held-out views: pictures where the job kept them, and the figures of all.
pub(super) fn pictures(test: &Scores, held_out: Option<&HeldOut>) -> Markup {
    let mut all: Vec<&ViewScore> = test.per_view.iter().collect();
    all.sort_by(|a, b| a.psnr.total_cmp(&b.psnr));
    html! {
        section {
            h2 { "Held-out views, worst first" }
            @match held_out {
                Some(sheet) => (shown(sheet)),
                None => p.none { "This job kept no pictures of its held-out views." },
            }
            @if !all.is_empty() {
                details open[held_out.is_none()] {
                    summary { "Figures of all " (all.len()) " views" }
                    table {
                        thead { tr { th scope="col" { "view" } th scope="col" { "PSNR, dB" } th scope="col" { "SSIM" } th scope="col" { "LPIPS" } } }
                        tbody {
                            @for view in all {
                                tr {
                                    th scope="row" { (view.name) }
                                    td { (figure(Some(view.psnr), 2)) }
                                    td { (figure(Some(view.ssim), 4)) }
                                    td { (figure(view.lpips, 4)) }
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

fn shown(sheet: &HeldOut) -> Markup {
    html! {
        p {
            @if sheet.views.len() < sheet.of {
                (sheet.views.len()) " of " (sheet.of) " views: the worst, and the best at the end. "
            }
            "From left to right: the photograph, the decoded file, and their difference, root mean square over the colors:"
        }
        (scale(sheet))
        @for view in &sheet.views { (row(view)) }
    }
}

/// The colors of the error maps with what they stand for.
fn scale(sheet: &HeldOut) -> Markup {
    let last = sheet.ramp.len().saturating_sub(1).max(1) as f64;
    let levels = (255.0 * sheet.ceiling).round();
    html! {
        svg.scale viewBox="0 0 560 40" role="img" aria-label="Colors of the error maps" {
            defs {
                linearGradient id="ramp" {
                    @for (place, [r, g, b]) in sheet.ramp.iter().enumerate() {
                        stop offset=(format!("{:.4}", place as f64 / last)) stop-color=(format!("rgb({r},{g},{b})")) {}
                    }
                }
            }
            rect x="8" y="2" width="544" height="14" fill="url(#ramp)" {}
            text.tick x="8" y="34" { "no error" }
            text.tick x="280" y="34" text-anchor="middle" { (levels / 2.0) " of 255 levels" }
            text.tick x="552" y="34" text-anchor="end" { (levels) " of 255 levels and more" }
        }
    }
}

fn row(view: &HeldOutView) -> Markup {
    let HeldOutView { score, width, height, .. } = view;
    let picture = |kind: &str, data: &str| {
        html! {
            img src=(format!("data:image/jpeg;base64,{data}")) width=(width) height=(height) alt=(format!("{kind} of {}", score.name));
        }
    };
    html! {
        figure.triple {
            (picture("photograph", &view.photograph))
            (picture("render", &view.render))
            (picture("error", &view.error))
            figcaption {
                b { (score.name) } "  " (figure(Some(score.psnr), 2)) " dB, SSIM " (figure(Some(score.ssim), 4))
                @if score.lpips.is_some() { ", LPIPS " (figure(score.lpips, 4)) }
            }
        }
    }
}
