//! Documents are written in short sentences.

use crate::support::tree::{files_under, text};

/// Most words of a sentence.
const MAX_WORDS: usize = 35;

/// Documents that are read today. `docs/history` has earlier ones.
fn documents() -> Vec<String> {
    let top =
        ["ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md", "FORMAT.md", "README.md"].map(str::to_owned);
    let below = ["docs", "crates"].into_iter().flat_map(files_under);
    let is_current = |path: &String| path.ends_with(".md") && !path.starts_with("docs/history/");
    top.into_iter().chain(below.filter(is_current)).collect()
}

/// The paragraphs and list items of a Markdown text on one line each, without code blocks, tables and headings.
fn paragraphs(text: &str) -> Vec<String> {
    let mut paragraphs = vec![String::new()];
    let mut is_code = false;
    for line in text.lines().map(str::trim) {
        let is_fence = line.starts_with("```");
        is_code ^= is_fence;
        let is_prose = !is_code && !is_fence && !line.is_empty() && !line.starts_with(['|', '#', '<']);
        let item = line.trim_start_matches(|c: char| c.is_ascii_digit()).trim_start_matches(['-', '*', '.']);
        let is_item = item.len() < line.len() && item.starts_with(' ');
        if !is_prose || is_item {
            paragraphs.push(String::new());
        }
        if is_prose {
            let paragraph = paragraphs.last_mut().expect("one at least");
            paragraph.push_str(if is_item { item } else { line });
            paragraph.push(' ');
        }
    }
    paragraphs.retain(|paragraph| !paragraph.trim().is_empty());
    paragraphs
}

/// A paragraph whose code spans are one word each.
fn without_code(paragraph: &str) -> String {
    paragraph.split('`').enumerate().map(|(index, part)| if index % 2 == 0 { part } else { "X" }).collect()
}

/// The sentences of a paragraph. A colon or semicolon ends one too, if an upper-case letter follows.
fn sentences(paragraph: &str) -> Vec<String> {
    let mut sentences = vec![Vec::new()];
    let words: Vec<&str> = paragraph.split_whitespace().collect();
    for (index, word) in words.iter().enumerate() {
        sentences.last_mut().expect("one at least").push(*word);
        let bare = word.trim_end_matches(['"', ')', '*', '_', '”']);
        let is_followed_by_upper_case = words.get(index + 1).is_some_and(|next| {
            next.trim_start_matches(['"', '(', '[', '*', '_', '“']).starts_with(char::is_uppercase)
        });
        if bare.ends_with(['.', '?', '!']) || (bare.ends_with([':', ';']) && is_followed_by_upper_case) {
            sentences.push(Vec::new());
        }
    }
    sentences.into_iter().filter(|words| !words.is_empty()).map(|words| words.join(" ")).collect()
}

fn count_words(sentence: &str) -> usize {
    sentence.split(' ').filter(|word| word.contains(char::is_alphanumeric)).count()
}

#[test]
fn no_sentence_of_the_documents_is_too_long() {
    let mut long = Vec::new();
    let mut seen = 0;
    for path in documents() {
        for paragraph in paragraphs(&text(&path)) {
            for sentence in sentences(&without_code(&paragraph)) {
                seen += 1;
                let words = count_words(&sentence);
                if words > MAX_WORDS {
                    long.push(format!("{path}: {words} words: {sentence}"));
                }
            }
        }
    }
    assert!(seen > 1000, "{seen} sentences");
    assert!(long.is_empty(), "{} sentences of more than {MAX_WORDS} words:\n{}", long.len(), long.join("\n"));
}

#[test]
fn sentences_are_told_apart() {
    let text = "# Title\n\nOne `a b. c` here. Two\ngoes on: Three\n\n- four; five\n- six.\n\n```sh\ncode. Code\n```\n| a. | B. |\n";
    let found: Vec<String> =
        paragraphs(text).iter().flat_map(|paragraph| sentences(&without_code(paragraph))).collect();
    assert_eq!(found, ["One X here.", "Two goes on:", "Three", "four; five", "six."]);
}
