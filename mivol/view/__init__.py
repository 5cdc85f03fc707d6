"""The live view: what is looked at (``subjects``), when it is drawn (``painter``), and the page in a browser (``page``).

Conventions. One thread draws: the caller of :func:`mivol.view.page.serve`. Threads of the web server put requests into an
:class:`mivol.view.painter.Inbox`, and never touch Dr.Jit.
"""
