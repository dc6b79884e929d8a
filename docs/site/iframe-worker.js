// Browsers give pages that are opened as files no workers. The search then runs in a hidden frame: a frame has a global
// scope of its own, in which the worker's script finds what it expects.
if (location.protocol === "file:") {
  window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super()
      this.waiting = []
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.appendChild(frame)
      const inner = frame.contentWindow
      const script = inner.document.createElement("script")
      script.src = url
      script.onload = () => {
        this.waiting.forEach((data) => this.hand(data))
        this.waiting = undefined
      }
      this.hand = (data) => inner.dispatchEvent(new inner.MessageEvent("message", { data }))
      inner.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }))
      inner.document.body.appendChild(script)
      this.terminate = () => frame.remove()
    }
    postMessage(data) {
      this.waiting ? this.waiting.push(data) : this.hand(data)
    }
  }
  window.Worker = window.IFrameWorker
}
