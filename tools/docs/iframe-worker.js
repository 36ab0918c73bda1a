/* The search runs in a worker, which a browser refuses to a page that is a file. There a frame takes its place. */
if (location.protocol === "file:") {
    window.Worker = class extends EventTarget {
        constructor(url) {
            super();
            this.waiting = [];
            this.frame = document.createElement("iframe");
            this.frame.hidden = true;
            this.frame.srcdoc =
                `<script>window.postMessage = data => parent.postMessage(data, "*");</script><script src="${url}"></script>`;
            window.addEventListener("message", event => {
                if (event.source === this.frame.contentWindow)
                    this.dispatchEvent(new MessageEvent("message", { data: event.data }));
            });
            this.frame.addEventListener("load", () => {
                const waiting = this.waiting;
                this.waiting = null;
                waiting.forEach(data => this.postMessage(data));
            });
            document.body.append(this.frame);
        }
        postMessage(data) {
            if (this.waiting) this.waiting.push(data);
            else this.frame.contentWindow.dispatchEvent(new this.frame.contentWindow.MessageEvent("message", { data }));
        }
        terminate() {
            this.frame.remove();
        }
    };
}
