//! The common result of all layouts: frames with lenses, poses and image files, before any image is opened.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use super::{
    error::{IngestError, IngestErrorKind, Result},
    lens::Lens,
    limits::Limits,
    points::Points,
};
use crate::domain::{Layout, Pose, Split, dataset::HOLD_OUT_EVERY};

/// A dataset as its tables state it.
pub(super) struct Plan {
    pub(super) layout: Layout,
    /// The distinct cameras.
    pub(super) lenses: Vec<Lens>,
    pub(super) frames: Vec<PlannedFrame>,
    pub(super) points: Option<Points>,
    /// Images that the tables list, also those that no split takes.
    pub(super) listed: BTreeSet<String>,
    /// The tables that list them.
    pub(super) listings: Vec<String>,
    /// Files that are not used and that a note explains.
    pub(super) noted: BTreeSet<String>,
    pub(super) notes: Vec<String>,
    /// Frames that are not called as their table calls them, by the normal form of the stated path.
    pub(super) aliases: BTreeMap<String, String>,
    /// Listed images that are missing, by the normal form of the stated path.
    pub(super) missing: BTreeSet<String>,
}

/// How much a table has listed so far.
pub(super) struct RecordCounter {
    what: &'static str,
    records: usize,
    name_bytes: usize,
}

impl RecordCounter {
    /// Nothing yet of `what`.
    pub(super) fn of(what: &'static str) -> Self {
        Self { what, records: 0, name_bytes: 0 }
    }

    /// Counts records.
    ///
    /// # Errors
    /// [`IngestErrorKind::TooManyRecords`].
    pub(super) fn add(&mut self, records: usize) -> Result<()> {
        self.records = self.records.saturating_add(records);
        if self.records > Limits::FRAMES {
            return Err(IngestErrorKind::TooManyRecords { what: self.what, limit: Limits::FRAMES });
        }
        Ok(())
    }

    /// Counts a file name.
    ///
    /// # Errors
    /// [`IngestErrorKind::TooManyNameBytes`].
    pub(super) fn name(&mut self, name: &str) -> Result<()> {
        self.name_bytes = self.name_bytes.saturating_add(name.len());
        if self.name_bytes > Limits::NAME_BYTES {
            return Err(IngestErrorKind::TooManyNameBytes { limit: Limits::NAME_BYTES });
        }
        Ok(())
    }
}

/// A mask as a transforms file states it.
#[derive(Debug)]
pub(super) struct StatedMask {
    /// The file that states it.
    pub(super) listing: String,
    /// JSON pointer to the field.
    pub(super) place: String,
    /// The path that it states.
    pub(super) path: Option<String>,
}

/// One listed frame.
#[derive(Debug, Clone)]
pub(super) struct PlannedFrame {
    /// Name of the frame.
    pub(super) name: String,
    /// Its image in the tree.
    pub(super) file: String,
    /// Index into [`Plan::lenses`].
    pub(super) lens: usize,
    pub(super) pose: Pose,
    pub(super) split: Split,
    /// Its mask as the table states it.
    pub(super) mask: Option<Arc<StatedMask>>,
}

impl Plan {
    /// A plan without frames.
    pub(super) fn new(layout: Layout) -> Self {
        Self {
            layout,
            lenses: Vec::new(),
            frames: Vec::new(),
            points: None,
            listed: BTreeSet::new(),
            listings: Vec::new(),
            noted: BTreeSet::new(),
            notes: Vec::new(),
            aliases: BTreeMap::new(),
            missing: BTreeSet::new(),
        }
    }

    /// Adds a frame that the table `listing` lists.
    pub(super) fn add(&mut self, frame: PlannedFrame, listing: &str) {
        self.listed.insert(frame.file.clone());
        if self.listings.last().is_none_or(|last| last != listing) {
            self.listings.push(listing.to_owned());
        }
        self.frames.push(frame);
    }

    /// Takes the points of `file`, unless there are none; what is missing of them is noted.
    pub(super) fn take_points(&mut self, points: Points, file: &str) {
        if points.count() == 0 {
            self.notes.push(format!("{file} has no points: training starts from random ones"));
            return;
        }
        if !points.has_colors() {
            self.notes.push(format!("the points of {file} have no colors: training starts from gray ones"));
        }
        self.points = Some(points);
    }

    /// Sorts the frames by name and checks that names and image files are unique and that there is one to train on.
    ///
    /// # Errors
    /// [`IngestErrorKind::DuplicateName`] or [`IngestErrorKind::NoImages`], at `listing`.
    pub(super) fn ordered(mut self, listing: &str) -> Result<Self, IngestError> {
        self.frames.sort_by(|a, b| a.name.cmp(&b.name));
        if let Some(pair) = self.frames.windows(2).find(|pair| pair[0].name == pair[1].name) {
            return Err(IngestErrorKind::DuplicateName(pair[0].name.clone()).at(listing));
        }
        let mut files = BTreeSet::new();
        if let Some(frame) = self.frames.iter().find(|frame| !files.insert(&frame.file)) {
            return Err(IngestErrorKind::DuplicateName(frame.file.clone()).at(listing));
        }
        if !self.frames.iter().any(|frame| frame.split == Split::Train) {
            return Err(IngestErrorKind::NoImages.at(listing));
        }
        Ok(self)
    }

    /// Holds out every eighth frame by name, the first among them; a single frame is for training.
    pub(super) fn hold_out(&mut self) {
        self.frames.sort_by(|a, b| a.name.cmp(&b.name));
        let alone = self.frames.len() == 1;
        for (index, frame) in self.frames.iter_mut().enumerate() {
            frame.split = if index % HOLD_OUT_EVERY == 0 && !alone { Split::Test } else { Split::Train };
        }
    }

    /// Holds out the eighth of all frames whose cameras are nearest to that of the first by name; a single frame is for training.
    /// Frames are sorted by name.
    pub(super) fn hold_out_sector(&mut self) {
        let Some(first) = self.frames.first().map(|frame| frame.pose.center()) else { return };
        let mut order: Vec<usize> = (0..self.frames.len()).collect();
        let distance = |index: &usize| (self.frames[*index].pose.center() - first).length_squared();
        // Stable: the first by name among equals.
        order.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
        let count = self.frames.len();
        let held_out = if count == 1 { 0 } else { count.div_ceil(HOLD_OUT_EVERY) };
        for (place, index) in order.into_iter().enumerate() {
            self.frames[index].split = if place < held_out { Split::Test } else { Split::Train };
        }
        self.notes.push(format!(
            "a sector is held out: the {held_out} photographs whose cameras are nearest to that of {}",
            self.frames[0].name
        ));
    }

    /// The index of a lens, added unless it equals the one before.
    pub(super) fn lens(&mut self, lens: Lens) -> usize {
        if self.lenses.last() != Some(&lens) {
            self.lenses.push(lens);
        }
        self.lenses.len() - 1
    }
}

/// The folder of a file, without the slash behind it; empty at the top.
pub(super) fn folder_of(name: &str) -> &str {
    name.rsplit_once('/').map_or("", |(folder, _)| folder)
}
