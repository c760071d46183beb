//! Where time goes on the host and on the device, by recording, stage and kernel.
//!
//! A profiled device waits after each submission, so host and device times do not overlap as they otherwise would. Results stay
//! the same to the bit.

use std::{
    collections::BTreeMap,
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

/// Stage of what is recorded before the first [`Recorder::stage`](super::Recorder::stage).
const NO_STAGE: &str = "-";

/// Stage of the host's time since the end of the recording before.
const BETWEEN: &str = "between recordings";

/// Times of all recordings with one label.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RecordingProfile {
    /// How many there were.
    pub recordings: u64,
    /// Host time of sending them to the device.
    pub submit: Duration,
    /// Host time of waiting for the device.
    pub wait: Duration,
    /// Host time of recording each stage, and of what the host did before the recording.
    pub stages: BTreeMap<&'static str, Duration>,
    /// Dispatches of each kernel in a stage and their time on the device; empty on an adapter without timestamps.
    pub kernels: BTreeMap<(&'static str, &'static str), (u64, Duration)>,
}

/// Times of all recordings of a device since it was opened, by label.
#[derive(Debug, Default)]
pub struct Profile {
    recordings: Mutex<BTreeMap<String, RecordingProfile>>,
    /// When the last recording was done on the device.
    last_end: Mutex<Option<Instant>>,
}

impl Profile {
    /// The times so far.
    #[must_use]
    pub fn recordings(&self) -> BTreeMap<String, RecordingProfile> {
        self.recordings.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Begins a recording.
    pub(super) fn begin(&self, label: &str) -> RecordingTimes {
        let last_end = *self.last_end.lock().unwrap_or_else(PoisonError::into_inner);
        RecordingTimes::begin(label, last_end.map(|end| end.elapsed()))
    }

    /// Adds a recording, with the kernel and time of each dispatch.
    pub(super) fn add(
        &self,
        times: RecordingTimes,
        submit: Duration,
        wait: Duration,
        dispatches: impl IntoIterator<Item = (&'static str, Duration)>,
    ) {
        let RecordingTimes { label, stages, dispatch_stages, .. } = times;
        let mut recordings = self.recordings.lock().unwrap_or_else(PoisonError::into_inner);
        let sum = recordings.entry(label).or_default();
        sum.recordings += 1;
        sum.submit += submit;
        sum.wait += wait;
        for (stage, time) in stages {
            *sum.stages.entry(stage).or_default() += time;
        }
        for (stage, (kernel, time)) in dispatch_stages.into_iter().zip(dispatches) {
            let (count, sum) = sum.kernels.entry((stage, kernel)).or_default();
            *count += 1;
            *sum += time;
        }
        *self.last_end.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
    }
}

/// Times of one recording.
#[derive(Debug)]
pub(super) struct RecordingTimes {
    label: String,
    stage: &'static str,
    since: Instant,
    stages: Vec<(&'static str, Duration)>,
    /// The stage of each dispatch.
    dispatch_stages: Vec<&'static str>,
}

impl RecordingTimes {
    fn begin(label: &str, before: Option<Duration>) -> Self {
        Self {
            label: label.to_owned(),
            stage: NO_STAGE,
            since: Instant::now(),
            stages: before.map(|before| (BETWEEN, before)).into_iter().collect(),
            dispatch_stages: Vec::new(),
        }
    }

    /// Ends the current stage and begins another.
    pub(super) fn stage(&mut self, name: &'static str) {
        self.stages.push((self.stage, self.since.elapsed()));
        self.stage = name;
        self.since = Instant::now();
    }

    pub(super) fn dispatch(&mut self) {
        self.dispatch_stages.push(self.stage);
    }

    /// Ends the last stage.
    pub(super) fn end(&mut self) {
        self.stage(NO_STAGE);
    }
}

#[cfg(test)]
mod tests {
    use crate::gpu::{DeviceSettings, KernelSource, testing::lavapipe_with};

    const DOUBLE: KernelSource = KernelSource {
        name: "double",
        text: "@group(0) @binding(0) var<storage, read_write> values: array<u32>;\n\
               @compute @workgroup_size(64) fn double(@builtin(global_invocation_id) id: vec3u) {\n\
               if id.x < arrayLength(&values) { values[id.x] *= 2u; } }",
    };

    #[test]
    fn a_profile_counts_recordings_and_dispatches_by_stage_and_changes_no_result() {
        let run = |profile: bool| {
            let device = lavapipe_with(&DeviceSettings { profile, ..DeviceSettings::default() });
            let kernel = device.kernel(DOUBLE, &[]).expect("compiles");
            let values = device.upload("values", &[1_u32, 2, 3]).expect("room");
            for _ in 0..2 {
                let mut recorder = device.recorder("doubling");
                recorder.stage("once");
                recorder.dispatch(&kernel, &[&values], 1);
                recorder.stage("twice more");
                recorder.dispatch(&kernel, &[&values], 1);
                recorder.dispatch(&kernel, &[&values], 1);
                recorder.submit().expect("submitted");
            }
            (device.read(&values).expect("read"), device.profile().map(super::Profile::recordings))
        };
        let (plain, none) = run(false);
        assert!(none.is_none());
        let (profiled, recordings) = run(true);
        assert_eq!(profiled, plain);
        let recordings = recordings.expect("a profile");
        let times = &recordings["doubling"];
        assert_eq!(times.recordings, 2);
        let stages: Vec<_> = times.stages.keys().copied().collect();
        assert_eq!(stages, ["-", "between recordings", "once", "twice more"]);
        let counts: Vec<_> = times.kernels.iter().map(|(key, (count, _))| (*key, *count)).collect();
        assert_eq!(counts, [(("once", "double"), 2), (("twice more", "double"), 4)]);
    }
}
