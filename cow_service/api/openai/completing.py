"""Who completes a chat: the MLLM behind its model, or a job as of `POST /answer`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from anyio import to_thread
from fastapi import Request, Response

from cow_service.api.openai.chats import Chat
from cow_service.api.openai.forwarding import Whole
from cow_service.api.openai.models import answerer
from cow_service.api.openai.parsing import ParsedChat, parse_chat
from cow_service.api.openai.proxy import Proxy, preferences_without_key
from cow_service.api.openai.replies import ChatAnswer
from cow_service.api.openai.stream import Streamed, answer_events
from cow_service.api.submission import Submission, Submitter
from cow_service.errors import CowError


class Completer:
    """Completes chats on an engine."""

    def __init__(self, submitter: Submitter) -> None:
        self._submitter = submitter
        self._service = submitter.engine.service
        self._proxy = Proxy(submitter)

    async def close(self) -> None:
        """Closes connections."""
        await self._proxy.close()

    async def complete(self, request: Request, chat: Chat, *, stored: bool = True) -> Whole | Streamed | Response:
        """The reply; a response where the caller takes the job instead, which needs `stored`.

        Raises `ModelNotFound`, `InvalidRequest`, and what the MLLM or the job fails with.
        """
        who = answerer(self._service, chat.model)
        reader = await to_thread.run_sync(self._service.chat_reader, who.reader)
        if reader is not None:
            return await self._proxy.complete(request, chat, who, reader)
        submission = self._submitter.submission(request, "answer")
        if not stored:
            submission = replace(submission, prefer=preferences_without_key(request))
        parsed = await self._submitter.in_thread(partial(parse_chat, chat, who))
        try:
            return await self._answered(request, submission, parsed)
        except CowError as error:
            raise parsed.pointers.translate_error(error) from error

    async def _answered(
        self, request: Request, submission: Submission, chat: ParsedChat
    ) -> Whole | Streamed | Response:
        """The reply of a job. Errors point into its `AnswerRequest`."""
        submitter = self._submitter
        if chat.stream:
            created_at = await submitter.submit(submission, chat.request, None)
            events = answer_events(submitter, submission, chat, created_at)
            left = partial(submitter.leave, submission, created_at)
            return Streamed(events, chat.pointers.translate_error, left)
        result = await submitter.result(request, submission, chat.request, None)
        if result is None:
            return await submitter.accepted(submission)
        return Whole(await to_thread.run_sync(lambda: ChatAnswer.parse(chat, result).completion()))
