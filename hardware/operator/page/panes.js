// What a message of pictures holds, and the cameras' panes that show it: one for each name, made when it is first told.
import { CameraPane } from "./camera.js";

// a message's head, and of each of its pictures [whole, near], null where there is none
export async function unpacked(data) {
  const size = new DataView(data).getUint32(0, true), head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
  let offset = 4 + size;
  const image = (size = 0) => {
    const bytes = new Blob([new Uint8Array(data, offset, size)], { type: "image/jpeg" });
    offset += size;
    return size ? createImageBitmap(bytes).catch(() => null) : null;
  };
  return { head, images: await Promise.all(head.pictures.map((each) => Promise.all([image(each.size), image(each.near)]))) };
}

export class Panes extends Map {
  constructor(root, choose, hand) {
    super();
    [this.root, this.choose, this.hand] = [root, choose, hand];
  }
  of(name) {
    if (!this.has(name)) {
      const made = new CameraPane(name, this.choose, this.hand);
      this.set(name, made);
      this.root.append(made.root);
    }
    return this.get(name);
  }
  async show(data) {
    return this.put(await unpacked(data));
  }
  put({ head, images }) {
    head.pictures.forEach((each, k) => images[k][0] && this.of(each.camera).show(...images[k], each));
    return head;
  }
}
