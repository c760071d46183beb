//! The API over a real socket, a file for each part of it. Every answer is held to `openapi.yaml`, and one test asserts that
//! every operation and status of it was seen.

mod access;
mod artifacts;
mod connections;
mod cross_site;
mod estimate;
mod events;
mod exports;
mod figures;
mod forms;
mod front;
mod idempotency;
mod job_actions;
mod jobs;
mod operations;
mod projects;
mod report;
mod reservations;
mod scenes;
mod secrets;
mod sequences;
mod series;
mod service;
mod sessions;
mod shares;
mod uploads;
mod viewer_page;
mod views;
mod webhooks;

use crate::support::contract::Coverage;

/// Makes each scenario a test, and one more that runs all of them and asserts that the contract is covered.
macro_rules! scenarios {
    ($($part:ident { $($name:ident),+ $(,)? })+) => {
        mod one_by_one {
            $(mod $part {
                use crate::{http, support::contract::Coverage};
                $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
                async fn $name() {
                    http::$part::$name(Coverage::default()).await;
                })+
            })+
        }

        #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
        async fn every_operation_and_status_of_the_contract_is_seen() {
            let coverage = Coverage::default();
            $($(Box::pin($part::$name(coverage.clone())).await;)+)+
            let missing = coverage.missing();
            assert!(missing.is_empty(), "never seen: {missing:#?}");
        }
    };
}

scenarios! {
    service {
        the_service_describes_itself,
        unknown_jobs_frames_paths_and_methods_are_problems,
        a_database_that_fails_is_a_problem_not_a_crash,
        a_handler_that_panics_answers_500_and_the_server_lives,
    }
    access {
        no_operation_answers_without_the_right_key,
        the_first_key_closes_the_service_and_revoking_the_last_does_not_open_it,
        a_browser_shows_its_key_by_basic_and_changes_nothing_by_it,
        a_key_has_its_rate_and_an_address_a_few_failures,
        keys_are_made_listed_and_revoked_by_administrators,
        a_key_has_room_for_some_jobs_and_bytes,
        what_is_anothers_is_not_there,
        a_database_that_fails_lets_nobody_in,
    }
    front {
        a_browser_gets_a_page_of_its_jobs,
        the_page_shows_nothing_without_a_key,
    }
    sessions {
        a_browser_signs_in_by_its_key_and_changes_things_from_its_own_pages_only,
        a_session_ends_with_its_key_its_age_or_by_signing_out,
    }
    shares {
        a_link_opens_a_jobs_page_and_what_it_shows_and_nothing_else,
        a_link_may_open_one_thing_alone,
        a_link_of_a_page_alone_opens_what_the_page_loads,
        every_replica_knows_the_links_of_the_others,
    }
    projects {
        a_leaked_key_is_replaced_and_nothing_is_lost,
        projects_are_made_changed_and_listed_by_administrators,
        keys_expire_and_are_changed,
        usage_is_shown_by_project,
        what_an_administrator_makes_of_a_projects_things_is_the_projects,
        jobs_have_names_labels_attempts_and_places_in_the_queue,
    }
    connections {
        bodies_that_break_off_or_dawdle_are_given_up,
    }
    reservations {
        below_the_floor_of_free_space_nothing_is_taken_in,
    }
    operations {
        metrics_tell_of_requests_jobs_and_the_machine,
        metrics_have_a_listener_of_their_own_where_one_is_given,
        readiness_names_what_is_wrong,
    }
    jobs {
        a_dataset_becomes_a_file_with_metrics_and_history,
        what_is_wrong_with_a_dataset_or_an_option_is_said_before_a_job_is_made,
        jobs_are_listed_newest_first_page_by_page,
        a_queued_job_is_cancelled_at_once_and_a_running_one_soon,
        too_many_uploads_at_once_are_put_off,
    }
    estimate {
        a_job_is_estimated_by_finished_jobs_and_nothing_is_created,
        what_cannot_be_estimated_is_refused_or_noted,
    }
    events {
        a_stream_tells_everything_once_and_ends_with_the_job,
        a_list_tells_of_each_job_that_changes,
        there_are_only_so_many_streams,
    }
    series {
        the_course_of_training_is_served_as_columns,
    }
    job_actions {
        a_job_is_made_of_a_scene_by_json,
        jobs_are_listed_by_state_scene_and_model,
        a_job_is_given_up_at_its_deadline_begun_or_not,
        a_failed_or_cancelled_job_is_retried_as_a_new_one,
        a_job_is_repeated_with_other_options,
        the_name_and_labels_of_a_job_are_changed,
        a_client_names_the_fields_that_it_wants,
        a_job_that_has_ended_is_deleted_with_its_files,
    }
    idempotency {
        a_request_that_is_sent_again_makes_nothing_again,
        what_was_refused_is_not_remembered,
        fifty_requests_with_one_key_make_one_job,
        a_request_is_in_flight_until_it_is_answered_and_no_longer,
        an_answer_waits_for_the_job_as_long_as_is_preferred,
    }
    scenes {
        a_dataset_is_kept_once_and_found_again,
        both_names_of_datasets_mean_the_same,
        missing_photographs_are_left_out_if_that_is_asked_for,
        masks_are_read_as_is_asked_for,
        a_scope_on_datasets_is_that_on_scenes,
        what_cannot_be_a_scene_is_refused_before_there_is_one,
        a_body_is_held_to_its_announced_digest,
        a_scene_sent_twice_with_one_key_is_made_once,
        scenes_are_listed_newest_first_page_by_page,
        a_scene_is_deleted_once_no_job_needs_it,
        scenes_of_another_key_are_not_there_and_bytes_have_a_quota,
    }
    forms {
        a_dataset_comes_in_a_form_or_as_bytes,
        what_is_wrong_with_a_form_is_said,
        a_job_that_came_with_a_dataset_names_it,
    }
    uploads {
        a_project_has_so_many_open_uploads,
        a_dataset_comes_in_parts_and_becomes_a_scene,
        headers_that_make_no_sense_are_named,
        methods_come_through_proxies_as_post,
        parts_that_do_not_fit_change_nothing,
        an_upload_that_waits_too_long_is_over,
        room_is_kept_from_the_beginning,
        bodies_of_parts_that_dawdle_or_break_off_keep_what_came,
        one_request_at_a_time_writes,
    }
    exports {
        every_file_of_a_job_is_listed_and_served_by_its_hash,
        a_scene_is_exported_once_and_kept,
        an_export_that_cannot_be_is_said_so,
        an_export_needs_room_within_its_owners_quota,
        few_exports_are_made_at_a_time_and_each_for_all_who_ask,
        one_project_leaves_places_for_the_exports_of_others,
    }
    webhooks {
        endpoints_are_made_listed_and_deleted_and_show_their_secret_once,
        what_is_wrong_with_an_endpoint_is_said,
        a_jobs_life_is_told_in_signed_messages,
        a_message_under_way_is_not_sent_again,
        an_endpoint_that_is_gone_is_told_nothing_more,
        endpoints_belong_to_their_key,
    }
    artifacts {
        the_file_is_served_whole_in_parts_and_conditionally,
        a_finished_job_has_a_thumbnail,
        a_job_in_training_has_a_preview,
        a_damaged_file_is_not_sent_as_the_whole_one,
        every_file_of_a_curve_is_served_by_its_weight,
    }
    report {
        a_finished_job_is_reported_on_one_page,
        a_curve_is_reported_with_each_of_its_files,
        a_job_without_a_result_is_reported_as_it_stands,
        a_report_has_the_names_and_files_of_its_job,
    }
    viewer_page {
        the_page_of_a_job_has_its_cameras_and_its_own_policy,
        a_job_without_a_file_has_no_page_yet,
        the_module_comes_compressed_to_those_who_take_it_so,
    }
    views {
        views_by_frame_pose_and_query_agree,
        a_view_without_a_camera_is_that_of_the_first_held_out_one,
        the_cameras_of_a_job_are_views_of_it,
        views_come_in_three_formats_and_as_multipart,
        depth_and_alpha_are_served_as_pictures_and_as_numbers,
        a_view_is_tagged_timed_and_rendered_once,
        a_view_that_many_ask_for_at_once_is_rendered_once,
        impossible_views_are_refused_by_name,
        a_job_without_a_file_has_no_views,
        a_picture_is_rendered_while_another_is_encoded,
        a_full_render_queue_and_a_broken_renderer_are_told_apart,
    }
    sequences {
        an_orbit_is_streamed_part_by_part_as_often_as_asked,
        a_path_is_animated_through_its_views,
        an_animation_is_written_as_webp_too,
        an_orbit_is_one_file_with_a_tag,
        impossible_sequences_are_refused_by_name,
        sequences_fail_as_views_do,
        what_fails_after_the_first_picture_breaks_the_body_off,
        each_caller_has_its_share_and_all_together_a_limit,
        whoever_goes_away_is_not_rendered,
        nothing_is_rendered_that_the_client_does_not_take,
        sequences_are_rendered_while_a_job_trains,
    }
}
