"""A page in a browser that shows a run while it goes on; `evstim run --serve`.

session --events, light (shared memory)--> page's process --pictures--> viewers (WebSocket)
        --status (pipe)----------------->                 --status---->
        <--commands (pipe)---------------                 <--commands--
"""
