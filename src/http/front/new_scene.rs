//! The panel that sends a dataset and makes a job of it. Its script does the work, so it shows only where scripts run.

use maud::{Markup, html};

use crate::domain::{Preset, TrainOptions};

pub(super) fn panel() -> Markup {
    let usual = TrainOptions::default().preset;
    html! {
        section #new {
            h2 { "New scene" }
            noscript { p.none { "Sending photographs takes a browser with scripts; any HTTP client does the same." } }
            div #drop.drop hidden {
                p.lead { "Drop photographs, a folder or a zip here" }
                p {
                    button #pick-files.first type="button" { "Choose files" } " "
                    button #pick-folder type="button" { "Choose a folder" }
                }
                input #files type="file" multiple hidden aria-label="Files";
                input #folder type="file" webkitdirectory hidden aria-label="Folder";
                p.hint { "JPEG, PNG or WebP photographs, a video, or a dataset with its cameras." }
                p { label { input #unmasked type="checkbox"; " Read photographs whole, without masks" } }
            }
            div #sending hidden {
                p { b #sending-name {} }
                progress #sending-progress max="1" value="0" aria-label="Sent" {}
                p #sending-text role="status" {}
                button #stop type="button" { "Stop" }
            }
            form #train hidden {
                p #dataset-text {}
                label for="name" { "Name" }
                input #name maxlength="100" autocomplete="off";
                fieldset {
                    legend { "Preset" }
                    @for preset in Preset::ALL {
                        label.preset {
                            input type="radio" name="preset" value=(preset.name()) checked[preset == usual];
                            " " b { (preset.name()) } " " span.hint { (purpose(preset)) } " "
                            output data-preset=(preset.name()) {}
                        }
                    }
                }
                div.actions {
                    button.first { "Train" }
                    button #put-aside type="button" { "Not now" }
                }
            }
            p #trouble.trouble role="alert" hidden {}
        }
    }
}

/// What a preset is for, as docs/PRESETS.md has it.
fn purpose(preset: Preset) -> &'static str {
    match preset {
        Preset::Preview => "for a CPU, or for a first look",
        Preset::Standard => "for a scene to keep",
        Preset::Paper => "to compare with the publication",
    }
}
