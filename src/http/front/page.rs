//! The frame of the page: head, header and the two contents that it may have.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::{jobs, new_scene};
use crate::store::JobRecord;

/// The page's only script and only style; the policy that it is served under names their hashes.
pub(super) const SCRIPT: &str = concat!(
    include_str!("common.js"),
    include_str!("sign_in.js"),
    include_str!("jobs.js"),
    include_str!("upload.js")
);
pub(super) const STYLE: &str = concat!(include_str!("../report/style.css"), include_str!("style.css"));

/// What the page shows.
#[derive(Debug)]
pub(super) enum Front {
    /// To those without a key, once there are keys.
    SignIn,
    Jobs {
        has_key: bool,
        /// Whether these are the newest jobs.
        is_first: bool,
        jobs: Vec<JobRecord>,
        /// Where the next ones are.
        next: Option<String>,
    },
}

impl Front {
    pub(super) fn html(&self) -> Markup {
        html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    // Or browsers would ask the service for one.
                    link rel="icon" href="data:,";
                    title { "tcgs" }
                    style { (PreEscaped(STYLE)) }
                }
                body.front {
                    header.top {
                        h1 { a href="." { "tcgs" } }
                        nav {
                            a href="openapi.yaml" { "API" }
                            @if matches!(self, Front::Jobs { has_key: true, .. }) {
                                button #sign-out type="button" { "Sign out" }
                            }
                        }
                    }
                    main { (self.content()) }
                    footer { p { "tcgs " (env!("CARGO_PKG_VERSION")) } }
                    script { (PreEscaped(SCRIPT)) }
                }
            }
        }
    }

    fn content(&self) -> Markup {
        match self {
            Front::SignIn => sign_in(),
            Front::Jobs { is_first, jobs, next, .. } => html! {
                (new_scene::panel())
                (jobs::section(jobs, *is_first, next.as_deref()))
            },
        }
    }
}

fn sign_in() -> Markup {
    html! {
        section {
            h2 { "Sign in" }
            p { "This service answers those who have a key." }
            form #sign-in {
                label for="key" { "Key" }
                input #key type="password" autocomplete="current-password" placeholder="tcgs_..." required autofocus spellcheck="false";
                button.first { "Sign in" }
            }
            p #told role="status" {}
            p.hint { "Its operator makes one with " code { "tcgs keys create" } ". The browser keeps no key, but a session that ends with it." }
        }
    }
}
