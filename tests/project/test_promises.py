"""SECURITY.md promises no more than tests hold."""

from __future__ import annotations

import re

from conftest import ROOT, TESTS

# What is promised there, and the test that holds it.
HELD = {
    "a key where `COW_API_KEYS` is set, except on `/livez`, `/readyz`": "test_nothing_but_probes_without_a_key",
    "size and time of the body": "test_a_body_whose_end_does_not_arrive",
    "the image's type and size before it is decoded": "test_the_size_is_refused_from_the_header",
    "foreign pages are refused": "test_a_foreign_page_is_refused",
    "only public addresses are asked": "test_every_address_of_a_name_must_be_permitted_and_none_is_told",
    "every redirect and address anew": "test_every_hop_is_checked",
    "those of `/v1` chats too": "test_no_url_that_leads_inside_is_sent_on",
    "webhooks only with `COW_WEBHOOK_SECRET`": "test_what_is_never_called_is_refused_at_once",
    "one deadline for everything": "test_one_clock_for_name_and_redirects_together",
    "OpenAI's fields and those of `COW_CHAT_FIELDS`": "test_only_fields_of_openai_and_listed_ones_are_sent_on",
    "pictures as data": "test_pictures_by_url_are_fetched_once_and_sent_as_data",
    "replies have at most 16 MB, unpacked": "test_a_reply_that_unpacks_to_too_much_is_given_up",
    "parsed, checked against the image": "test_no_reply_breaks_the_reading",
    "of errors only status and code": "test_what_the_mllm_refuses_comes_back_with_its_status_and_code_alone",
    "see neither each other's jobs nor artifacts": "test_a_job_and_its_artifacts_are_its_owners_alone",
    "are also told hosts, process ids and ids of jobs": "test_processes_are_shown_while_they_tell_of_themselves",
    "has the mode 0600, folders 0700": "test_what_is_kept_is_for_its_own_user_alone",
    "Bytes of artifacts are compared with their SHA-256": "test_what_is_damaged_is_not_handed_out_and_heals",
    "digests that `cow models pull` compared": "test_bytes_that_are_not_those_listed_are_thrown_away",
    "pickles are refused": "test_a_pickle_is_pulled_only_where_the_manifest_says_so_and_runs_no_code",
    "no decoder runs": "test_no_decoder_runs_where_requests_are_taken",
    "which cannot change tables": "test_a_server_runs_on_tables_that_it_may_not_create",
    "two secrets at a time": "test_an_end_is_told_once_and_signed",
    "Images run as user 10001": "test_it_starts_the_server_as_a_user_who_writes_to_volumes_alone",
    "a read-only root, no capabilities": "test_the_service_is_set_up_and_may_do_little",
    "by SHA-256 and as wheels only": "test_nothing_is_installed_but_what_is_locked",
    "a line has at most 10,000 characters": "test_a_line_has_an_end_whatever_was_sent",
}


def test_every_promise_is_held_by_a_test() -> None:
    page = " ".join((ROOT / "SECURITY.md").read_text().split())
    assert [promise for promise in HELD if promise not in page] == []
    tests = {name for path in TESTS.rglob("test_*.py") for name in re.findall(r"def (test_\w+)", path.read_text())}
    assert sorted(set(HELD.values()) - tests) == []
